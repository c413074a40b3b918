"""What bands share of a block."""

import threading

from zonda.core.shared import ROOM, SharedScan, of_block


def test_of_block_keeps_what_is_made_until_the_block_ends():
    shared, made = SharedScan(100), []

    def make():
        made.append(None)
        return len(made)

    with shared.block():
        assert [shared.of_block("pixels", 60, make) for _ in range(2)] == [1, 1]
        assert shared.of_block("angles", 60, make) == 2  # no room for it
        assert shared.of_block("angles", 60, make) == 3
        assert not shared.claim(60)
    assert shared.claim(100)
    shared.claim(-100)
    with shared.block():
        assert shared.of_block("pixels", 60, make) == 4


def test_of_block_makes_alone_outside_of_a_block_and_in_other_threads():
    shared, made = SharedScan(ROOM), []
    assert [shared.of_block("pixels", 8, lambda: made.append(None)) for _ in range(2)] == [
        None,
        None,
    ]
    assert len(made) == 2
    assert of_block(None, "pixels", 8, lambda: 5) == 5
    with shared.block():
        shared.of_block("pixels", 8, lambda: made.append(None))
        other = threading.Thread(
            target=lambda: shared.of_block("pixels", 8, lambda: made.append(None))
        )
        other.start()
        other.join()
    assert len(made) == 4


def test_what_bands_put_off_is_done_once_for_all_that_have_the_same_key():
    shared, done = SharedScan(ROOM), []
    assert not shared.put_off(
        "BinMap", "key", 0, done.append
    )  # outside of a block nothing is put off
    for _ in range(2):
        with shared.block():
            assert all(
                shared.put_off("BinMap", key, part, done.append)
                for key, part in [("a", 1), ("b", 2), ("a", 3)]
            )
            assert shared.put_off("BinMap 2", "a", 4, done.append)
            assert not done
            labels = []
            for label, work in shared.due():
                labels.append(label)
                work()
        assert labels == ["BinMap", "BinMap", "BinMap 2"]
        assert done == [[1, 3], [2], [4]]
        done.clear()
    assert not shared.put_off("BinMap", "key", 0, done.append)
