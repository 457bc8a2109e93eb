"""Earlier frames and those that follow, as one sequence."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from slam.frames import Sequence
from slam.runtime.errors import MissingFrameError, SequenceError
from slam.sequences.catalogue import open_sequence
from slam.sequences.continued import Continued, missing_between
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
    assert not joined.has_scan(11) and set(joined.provenance()) == set(whole.provenance())


def test_earlier_frames_are_not_kept(parts: tuple[Sequence, Sequence]) -> None:
    joined = continued(*parts)
    with pytest.raises(SequenceError, match="frame 8 of sim is of an earlier run"):
        joined.frame(8)
    with pytest.raises(SequenceError, match="14"):
        joined.frame(14)


def test_frames_of_a_simulated_world_are_told_by_its_clock(
    kitti_root: Path, parts: tuple[Sequence, Sequence], caplog: pytest.LogCaptureFixture
) -> None:
    later = continued(parts[0], open_sequence(kitti_root, "sim", frames="11:"))
    assert len(later) == 14 and later.reference is not None
    with pytest.raises(MissingFrameError, match="frame 9 of sim is missing between two runs"):
        later.frame(9)
    with pytest.raises(SequenceError, match=r"begin at 0\.6 s, before the last one at 0\.8 s: give the frames that"):
        continued(parts[0], open_sequence(kitti_root, "sim", frames="6:"))
    again = continued(parts[0], open_sequence(kitti_root, "sim", frames="0:9"))
    assert again.reference is None and "stamps of sim begin again" in caplog.text


def test_no_truth_where_one_part_has_none(parts: tuple[Sequence, Sequence]) -> None:
    before, following = parts
    assert isinstance(following, Excerpt)
    following.base.reference = None
    assert continued(before, following).reference is None


def test_stamps_that_restart_are_shifted(parts: tuple[Sequence, Sequence]) -> None:
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


def write_drive(root: Path, name: str, kitti_root: Path, frames: int = 14) -> Path:
    """A real (not simulated) KITTI root with the pictures of ``kitti_root``, which repeat."""
    old, new = kitti_root / "sequences/sim", root / "sequences" / name
    (new / "image_2").mkdir(parents=True)
    for number in range(frames):
        shutil.copy(old / f"image_2/{number % 14:06d}.png", new / f"image_2/{number:06d}.png")
    shutil.copy(old / "calib.txt", new)
    (new / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(frames)))
    (root / "poses").mkdir(exist_ok=True)
    (root / f"poses/{name}.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(frames)))
    return root


@pytest.mark.parametrize("first", [9, 12])
def test_a_gap_becomes_missing_frames(
    tmp_path: Path, kitti_root: Path, caplog: pytest.LogCaptureFixture, first: int
) -> None:
    root = write_drive(tmp_path, "00", kitti_root)
    whole = open_sequence(root)
    joined = continued(open_sequence(root, frames="0:9"), open_sequence(root, frames=f"{first}:"))
    assert (len(joined), joined.before) == (14, 9)
    assert joined.stamps == pytest.approx(whole.stamps)
    assert joined.reference is not None and whole.reference is not None
    np.testing.assert_allclose(joined.reference, whole.reference, atol=1e-12)
    for index in range(9, first):
        with pytest.raises(MissingFrameError, match=f"frame {index} of 00 is missing between two runs"):
            joined.frame(index)
    np.testing.assert_array_equal(joined.frame(12).image, whole.frame(12).image)
    assert joined.provenance() == ("kitti_odometry/00[0:9]", f"kitti_odometry/00[{first}:14]")
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == (first > 9) and all("3 frames between kitti_odometry/00[0:9]" in text for text in said)


def test_a_long_gap_is_refused(tmp_path: Path, kitti_root: Path) -> None:
    root = write_drive(tmp_path, "00", kitti_root, frames=125)
    with pytest.raises(SequenceError, match=r"101 frames between .* are missing \(10\.2 s\), too long a gap") as caught:
        continued(open_sequence(root, frames="0:9"), open_sequence(root, frames="110:"))
    assert "\n" not in str(caught.value)


def test_another_recording_is_refused(tmp_path: Path, kitti_root: Path) -> None:
    root = write_drive(write_drive(tmp_path, "00", kitti_root), "02", kitti_root)
    before = open_sequence(root, "00", frames="0:9")
    with pytest.raises(SequenceError, match=r"^kitti_odometry/02\[9:14\] cannot continue kitti_odometry/00\[0:9\]: "):
        continued(before, open_sequence(root, "02", frames="9:"))
    with pytest.raises(SequenceError, match="it is another recording"):
        continued(before, open_sequence(kitti_root, "sim", frames="9:"))


def test_frames_before_the_last_are_refused(tmp_path: Path, kitti_root: Path) -> None:
    root = write_drive(tmp_path, "00", kitti_root)
    with pytest.raises(SequenceError, match=r"00\[2:4\] does not come after kitti_odometry/00\[5:9\]"):
        continued(open_sequence(root, frames="5:9"), open_sequence(root, frames="2:4"))


def test_a_folder_is_assumed_to_follow(
    tmp_path: Path, kitti_root: Path, parts: tuple[Sequence, Sequence], caplog: pytest.LogCaptureFixture
) -> None:
    """Its name has no frame numbers: a camera may write a new folder for each part of a drive."""
    shutil.copytree(kitti_root / "sequences/sim/image_2", tmp_path / "part2")
    shutil.copy(kitti_root / "camera.yaml", tmp_path / "part2")
    assert len(continued(parts[0], open_sequence(tmp_path / "part2"))) == 9 + 14
    assert "folder/part2[0:14] is assumed to follow simulated/1001" in caplog.text


@pytest.mark.parametrize(
    ("before", "following", "missing"),
    [
        (("kitti_odometry/00[0:30]",), ("kitti_odometry/00[30:60]",), 0),
        (("kitti_odometry/00[0:30]", "kitti_odometry/00[30:60]"), ("kitti_odometry/00[65:70]",), 5),
        (("kitti_odometry/08[0:30]",), ("kitti_raw/2011_09_30_drive_0028[1132:1140]",), 2),
        (("simulated/3",), ("simulated/3",), 0),
        (("folder/br[ack]ets[0:5]",), ("folder/br[ack]ets[6:7]",), 1),
    ],
)
def test_missing_between(before: tuple[str, ...], following: tuple[str, ...], missing: int) -> None:
    assert missing_between(before, following) == missing


@pytest.mark.parametrize(
    ("before", "following"),
    [
        ("kitti_odometry/00[0:30]", "kitti_odometry/02[30:60]"),
        ("simulated/3", "simulated/4"),
        ("folder/a[0:5]", "kitti_odometry/00[5:9]"),
        ("kitti_odometry/00[0:30]", "kitti_odometry/00[29:60]"),
    ],
)
def test_what_does_not_follow(before: str, following: str) -> None:
    with pytest.raises(SequenceError):
        missing_between((before,), (following,))
