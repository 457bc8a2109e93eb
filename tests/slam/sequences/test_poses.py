"""True poses from a file of the user, for any recording."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.commands.doctor import examine
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence

FRAMES = 8


def true_poses() -> FloatArray:
    rotation, step = np.zeros((2, FRAMES - 1, 3))
    rotation[:, 1], step[:, 2] = 0.02, 1.0
    return chain(from_rotation_vector(rotation, step))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "walk" / "images"
    folder.mkdir(parents=True)
    for k in range(FRAMES):
        cv2.imwrite(str(folder / f"{k:03d}.png"), np.full((48, 64, 3), 10 * k, np.uint8))
    (folder / "camera.yaml").write_text(
        "{width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, fps: 10}"
    )
    return folder


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    return tmp_path / "truth.txt"


def reference(recording: Path, truth: Path, frames: str | None = None) -> FloatArray | None:
    return open_sequence(recording, frames=frames, truth=truth).reference


def test_a_row_a_frame(recording: Path, truth: Path):
    write_kitti(truth, Trajectory(np.arange(8.0), true_poses()))
    found = reference(recording, truth)
    assert found is not None
    np.testing.assert_allclose(found, true_poses(), atol=1e-6)
    part = reference(recording, truth, "3:6")
    assert part is not None
    np.testing.assert_allclose(part, np.linalg.inv(true_poses()[3]) @ true_poses()[3:6], atol=1e-6)


def test_rows_with_stamps_are_interpolated_at_the_frames(recording: Path, truth: Path):
    write_tum(truth, Trajectory(np.arange(0.0, 0.71, 0.1)[::2], true_poses()[::2]))
    found = reference(recording, truth, "0:7")
    assert found is not None
    np.testing.assert_allclose(found, true_poses()[:7], atol=0.02)


def test_rows_with_frame_numbers_are_of_these_frames(
    recording: Path, truth: Path, caplog: pytest.LogCaptureFixture
):
    rows = [f"{k} {' '.join(map(str, true_poses()[k, :3].ravel()))}\n" for k in range(3, FRAMES)]
    truth.write_text("".join(rows))
    assert reference(recording, truth) is None
    assert "has no pose of image 0" in caplog.text and "frames 2:8 have one each" in caplog.text
    part = reference(recording, truth, "2:8")
    assert part is not None
    np.testing.assert_allclose(part, np.linalg.inv(true_poses()[2]) @ true_poses()[2:], atol=0.1)


def test_poses_beside_a_folder_are_named_and_not_used(recording: Path):
    beside = recording.parent / "poses.kitti.txt"
    write_kitti(beside, Trajectory(np.arange(8.0), true_poses()))
    assert open_sequence(recording).reference is None
    line = examine(recording)[-1]
    assert f"no true poses (--truth {beside} gives some)" in line


def tum_rows() -> list[list[str]]:
    """Words of a file of all frames at 10 a second, the camera's rate."""
    poses = true_poses()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return [
        [f"{0.1 * k:.6f}", *map(repr, map(float, [*poses[k, :3, 3], *quaternions[k]]))]
        for k in range(FRAMES)
    ]


@pytest.mark.parametrize("wrong", ["nan", "cut off", "swapped", "reversed", "semicolons"])
def test_a_table_that_is_slightly_wrong_costs_no_reference(
    recording: Path, truth: Path, wrong: str
):
    rows = tum_rows()
    match wrong:
        case "nan":
            rows[4][1:] = ["nan"] * 7
        case "cut off":
            rows[-1] = rows[-1][:3]
        case "swapped":
            rows[3:5] = rows[4:2:-1]
        case "reversed":
            rows.reverse()
    truth.write_text("\n".join((";" if wrong == "semicolons" else " ").join(row) for row in rows))
    found = reference(recording, truth)
    assert found is not None
    np.testing.assert_allclose(found, true_poses(), atol=0.03)


def test_stamps_in_another_unit_are_named_and_divided_they_fit(recording: Path, truth: Path):
    rows = tum_rows()
    truth.write_text("\n".join(" ".join([f"{1e6 * float(t):.1f}", *others]) for t, *others in rows))
    with pytest.raises(
        SequenceError, match=r"look like microseconds: divide them by 1e\+06"
    ) as caught:
        reference(recording, truth)
    by = float(str(caught.value).rpartition(" ")[2])
    table = np.loadtxt(truth)
    table[:, 0] /= by
    np.savetxt(truth, table)
    assert reference(recording, truth) is not None
