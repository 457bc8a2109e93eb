"""The protocol of poses with oracle networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import Pinhole
from erfsfm.common.readers.frame_range import overlapping
from erfsfm.evaluation.pose_protocols import pose_protocol

STEP = (0.05, 0.0, 0.1)


class Oracle:
    """Right up to scale about the drive of ``write_root``, which it recognises by nothing but the calls."""

    measures = False

    def __init__(
        self, step: tuple[float, float, float], sources: int = 4, seen: Sequence[str] = ()
    ) -> None:
        self.step = np.array(step)
        self.sources = sources
        self.seen = seen

    @staticmethod
    def prepare(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return image

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.full(image.shape[:2], 3.0, np.float32)

    def measured_poses(
        self, guess: NDArray[np.float64], images: Sequence[NDArray[np.uint8]], camera: Pinhole
    ):
        assert (camera.height, camera.width) == images[0].shape[:2]
        return guess

    def guessed_poses(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
        assert len(images) == self.sources + 1
        T_source_target = np.tile(np.eye(4), (self.sources, 1, 1))
        offsets = [k for k in range(-self.sources // 2, self.sources // 2 + 1) if k]
        T_source_target[:, :3, 3] = [-k * self.step / 3 for k in offsets]  # another scale
        return T_source_target

    def leaks(self, names: Sequence[str]) -> list[str]:
        return overlapping(names, self.seen)


@pytest.mark.parametrize("name", ["00", "kitti_odometry/00"])
def test_pose(tmp_path: Path, write_root: Callable[..., Path], name: str):
    write_root(tmp_path, frames=9, step=STEP, cameras=("image_2", "image_3"))
    networks, straight = pose_protocol(Oracle(STEP), tmp_path, [name], "default", allow_leak=False)
    assert networks["snippets"] == 5
    assert networks["ate_mean"] == pytest.approx(0, abs=1e-9)
    assert straight["ate_mean"] > 0.01, "the drive slides sideways"
    assert networks["leak"] is False


def test_the_pose_network_alone_stands_beside_what_is_measured(
    tmp_path: Path, write_root: Callable[..., Path]
):
    write_root(tmp_path, frames=9, step=STEP)

    class Measuring(Oracle):
        measures = True
        guessed_poses = staticmethod(lambda images: np.tile(np.eye(4), (4, 1, 1)))

        def measured_poses(self, guess, images, camera):
            return Oracle.guessed_poses(self, images)

    rows = pose_protocol(Measuring(STEP), tmp_path, ["00"], "default", allow_leak=False)
    assert [row["method"] for row in rows] == [
        "networks",
        "pose network alone",
        "straight constant motion",
    ]
    assert rows[0]["ate_mean"] == pytest.approx(0, abs=1e-9) and rows[1]["ate_mean"] > 0.01


def test_frames_of_a_sequence_are_checked_for_leaks(
    tmp_path: Path, write_root: Callable[..., Path]
):
    write_root(tmp_path, frames=20, step=STEP)
    seen = Oracle(STEP, seen=["kitti_odometry/00[0:12]"])
    networks, _ = pose_protocol(seen, tmp_path, ["00[12:]"], "default", allow_leak=False)
    assert networks["snippets"] == 4 and networks["leak"] is False
    assert networks["recording"] == "kitti_odometry/00[12:20]"
    with pytest.raises(DataError):
        pose_protocol(seen, tmp_path, ["00[11:]"], "default", allow_leak=False)


def test_paper_fidelity_counts_four_empty_snippets(tmp_path: Path, write_root: Callable[..., Path]):
    write_root(tmp_path, frames=9, step=STEP)
    default = pose_protocol(Oracle(STEP), tmp_path, ["00"], "default", allow_leak=False)[1]
    paper = pose_protocol(Oracle(STEP), tmp_path, ["00"], "paper", allow_leak=False)[1]
    assert paper["ate_mean"] == pytest.approx(default["ate_mean"] * 5 / 9)
