"""7-Scenes and ScanNet: images, registered depth and one file of a true pose a frame."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.runtime.errors import MissingFrameError
from slam.sequences.catalogue import open_sequence, sequence_kinds

POSE = "0 0 1 {z}\n0 1 0 2\n-1 0 0 {k}\n0 0 0 1\n"  # turned about y: the camera looks along the world's x
LOST = "-inf -inf -inf -inf\n" * 4


@pytest.fixture
def chess(tmp_path: Path, images) -> Path:
    """Two sequences; of the first frame 2 is missing, and the depth of frame 1 has an unknown pixel."""
    for name in ("seq-01", "seq-02"):
        folder = tmp_path / "chess" / name
        images(folder, [f"frame-{k:06d}.color.png" for k in range(5)], 640, 480)
        for k in range(5):
            (folder / f"frame-{k:06d}.pose.txt").write_text(POSE.format(k=k, z=0))
    depth = np.full((480, 640), 1500, np.uint16)
    depth[0, 0] = 65535
    cv2.imwrite(str(tmp_path / "chess/seq-01/frame-000001.depth.png"), depth)
    (tmp_path / "chess/seq-01/frame-000002.color.png").unlink()
    return tmp_path / "chess"


@pytest.fixture
def scene(tmp_path: Path, images) -> Path:
    """Every tenth frame from 20 on; tracking was lost at the second."""
    folder = tmp_path / "scene0000_00"
    images(folder / "color", [f"{k}.jpg" for k in (20, 30, 40, 50)])
    for name, text in (("pose", POSE), ("intrinsic", "")):
        (folder / name).mkdir()
        for k in (20, 30, 40, 50) if text else ():
            (folder / name / f"{k}.txt").write_text(LOST if k == 30 else text.format(k=k, z=1))
    (folder / "intrinsic/intrinsic_color.txt").write_text("30 0 20 0\n0 31 12 0\n0 0 1 0\n0 0 0 1\n")
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "depth/40.png"), np.full((12, 20), 2500, np.uint16))
    return folder


def test_seven_scenes(chess: Path) -> None:
    assert sequence_kinds(chess) == {"seq-01": "7-Scenes", "seq-02": "7-Scenes"}
    sequence = open_sequence(chess, "seq-01")
    assert (sequence.name, len(sequence), sequence.intrinsics.fx) == ("chess_seq-01", 5, 585)
    assert np.diff(sequence.stamps) == pytest.approx(1 / 30)
    assert sequence.reference is not None
    assert sequence.reference[:, :3, 3] == pytest.approx(np.outer(np.arange(5), [-1, 0, 0]))
    assert sequence.true_depth_frames() == [1]
    assert (sequence.true_depth(1)[0, 0], sequence.true_depth(1)[1, 1]) == (0, 1.5)
    with pytest.raises(MissingFrameError, match=r"no image frame-000002\.color\.png"):
        sequence.frame(2)
    assert sequence.provenance() == ("7scenes/chess_seq-01[0:5]",)
    assert open_sequence(chess / "seq-02").name == "chess_seq-02"


def test_scannet(scene: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(scene)
    assert sequence_kinds(scene) == {"scene0000_00": "ScanNet"}
    assert (len(sequence), sequence.intrinsics.fy, sequence.intrinsics.width) == (4, 31, 40)
    assert sequence.stamps == pytest.approx(np.array([20, 30, 40, 50]) / 30)
    assert sequence.reference is None and "frames 2:4 have one each" in caplog.text
    assert sequence.true_depth_frames() == [2] and sequence.true_depth(2)[0, 0] == 2.5
    (scene / "intrinsic/intrinsic_color.txt").write_text("unknown")
    assert open_sequence(scene, camera=Path("fov=90")).intrinsics.fx == pytest.approx(20)
    part = open_sequence(scene, camera=Path("fov=90"), frames="2:4").reference
    assert part is not None and part[1, :3, 3] == pytest.approx([-10, 0, 0])
