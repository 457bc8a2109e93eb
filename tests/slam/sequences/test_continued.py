"""Frames of before and those that follow, as one sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.errors import SequenceError
from slam.frames import Sequence
from slam.sequences.catalogue import open_sequence
from slam.sequences.continued import Continued
from slam.sequences.excerpt import Excerpt


def continued(before: Sequence, following: Sequence) -> Continued:
    known = (before.intrinsics, before.stamps, before.camera_height_m, before.reference, before.provenance())
    return Continued(before.name, *known, following)


@pytest.fixture
def whole(kitti_root: Path) -> Sequence:
    return open_sequence(kitti_root, "sim")


@pytest.fixture
def parts(kitti_root: Path) -> tuple[Sequence, Sequence]:
    return open_sequence(kitti_root, "sim", frames="0:9"), open_sequence(kitti_root, "sim", frames="9:")


def test_two_ranges_are_the_whole(whole: Sequence, parts: tuple[Sequence, Sequence]) -> None:
    joined = continued(*parts)
    assert (len(joined), joined.before) == (14, 9)
    np.testing.assert_array_equal(joined.stamps, whole.stamps)
    assert joined.reference is not None and whole.reference is not None
    np.testing.assert_allclose(joined.reference, whole.reference, atol=1e-12)
    frame = joined.frame(11)
    assert (frame.index, frame.stamp) == (11, whole.stamps[11])
    np.testing.assert_array_equal(frame.image, whole.frame(11).image)
    assert joined.scan_path(11) is None and set(joined.provenance()) == set(whole.provenance())


def test_frames_of_before_are_gone(parts: tuple[Sequence, Sequence]) -> None:
    joined = continued(*parts)
    with pytest.raises(SequenceError, match="frame 8 of sim was looked at before and is not kept"):
        joined.frame(8)
    with pytest.raises(SequenceError, match="14"):
        joined.frame(14)


@pytest.mark.parametrize("gap", ["10:", "0:9"])
def test_no_truth_across_a_gap(kitti_root: Path, parts: tuple[Sequence, Sequence], gap: str) -> None:
    assert continued(parts[0], open_sequence(kitti_root, "sim", frames=gap)).reference is None


def test_no_truth_where_one_part_has_none(parts: tuple[Sequence, Sequence]) -> None:
    before, following = parts
    assert isinstance(following, Excerpt)
    following.base.reference = None
    assert continued(before, following).reference is None


def test_stamps_that_begin_anew_come_after(parts: tuple[Sequence, Sequence]) -> None:
    before, following = parts
    following.stamps = following.stamps - following.stamps[0]
    joined = continued(before, following)
    np.testing.assert_allclose(np.diff(joined.stamps), np.diff(before.stamps)[0], atol=1e-6)


def test_a_single_frame_of_an_unknown_rate(kitti_root: Path) -> None:
    before, following = (open_sequence(kitti_root, "sim", frames=frames) for frames in ("5:6", "2:3"))
    stamps = continued(before, following).stamps
    assert stamps[1] > stamps[0]


def test_another_camera_is_refused(parts: tuple[Sequence, Sequence]) -> None:
    before, following = parts
    following.intrinsics = following.intrinsics.resized(100, 50)
    with pytest.raises(SequenceError, match=r"another camera, 100 x 50 .* 208 x 64"):
        continued(before, following)
