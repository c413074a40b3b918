"""Flags: TOAST's bits, what they become in files, and what excludes a sample."""

import numpy as np
import pytest

from zonda.core.flags import (
    DEAD,
    DETECTOR_FLAGS,
    DETECTOR_MASK,
    EXCLUDE_DETECTOR,
    EXCLUDE_SAMPLE,
    INVALID,
    NOT_RECORDED,
    OPAQUE,
    PROCESSING,
    SAMPLE_FLAGS,
    SAMPLE_MASK,
    SUN_CLOSE,
    SUN_UP,
    TURNAROUND,
    from_file,
    good,
    in_file,
    of_before,
)

EVERY = np.arange(256, dtype=np.uint8)


@pytest.mark.parametrize(
    ("table", "exclude", "mask"),
    [
        (SAMPLE_FLAGS, EXCLUDE_SAMPLE, SAMPLE_MASK),
        (DETECTOR_FLAGS, EXCLUDE_DETECTOR, DETECTOR_MASK),
    ],
)
def test_toast_leaves_out_what_we_leave_out(table, exclude, mask):
    known = EVERY[(EVERY & ~np.uint8(sum(flag.bit for flag in table))) == 0]
    np.testing.assert_array_equal(good(in_file(known, table), mask), good(known, exclude))


def test_the_table():
    assert len({flag.bit for flag in SAMPLE_FLAGS}) == len(SAMPLE_FLAGS) == 8
    assert len({flag.bit for flag in DETECTOR_FLAGS}) == len(DETECTOR_FLAGS)
    assert in_file(np.array([OPAQUE, NOT_RECORDED | SUN_UP], np.uint8), SAMPLE_FLAGS).tolist() == [
        INVALID,
        INVALID | SUN_UP,
    ]
    assert in_file(np.array([OPAQUE, DEAD], np.uint8), DETECTOR_FLAGS).tolist() == [
        INVALID,
        INVALID,
    ]


def test_only_the_mask_excludes_and_the_sun_is_kept():
    found = from_file(EVERY, SAMPLE_MASK)
    np.testing.assert_array_equal(good(found, EXCLUDE_SAMPLE), (EVERY & 15) == 0)
    np.testing.assert_array_equal(found & (SUN_UP | SUN_CLOSE), EVERY & (SUN_UP | SUN_CLOSE))
    assert from_file(np.array([TURNAROUND, PROCESSING, INVALID], np.uint8), 1).tolist() == [
        0,
        0,
        INVALID,
    ]
    assert from_file(np.array([SUN_UP, SUN_CLOSE, 128], np.uint8), 16 | 128).tolist() == [
        SUN_UP | INVALID,
        SUN_CLOSE,
        INVALID,
    ]


def test_flags_of_before_exclude_what_they_excluded():
    for samples, exclude in ((True, EXCLUDE_SAMPLE), (False, EXCLUDE_DETECTOR)):
        np.testing.assert_array_equal(good(of_before(EVERY, samples=samples), exclude), EVERY == 0)
