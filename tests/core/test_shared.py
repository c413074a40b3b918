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
    assert [shared.of_block("pixels", 8, lambda: made.append(None)) for _ in range(2)] == [None, None]
    assert len(made) == 2
    assert of_block(None, "pixels", 8, lambda: 5) == 5
    with shared.block():
        shared.of_block("pixels", 8, lambda: made.append(None))
        other = threading.Thread(target=lambda: shared.of_block("pixels", 8, lambda: made.append(None)))
        other.start()
        other.join()
    assert len(made) == 4
