"""TUM's monocular benchmark: the FOV lens, stamps, true poses of start and end."""

from pathlib import Path

import numpy as np
import pytest

from erfsfm.common.readers.camera_file import camera_of
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence, sequence_kinds
from slam.sequences.undistortion import Undistortion

LENS = "0.5 0.8 0.5 0.5 0.9"


@pytest.fixture
def walk(tmp_path: Path, images) -> Path:
    folder = tmp_path / "sequence_01"
    images(folder / "images", [f"{k:05d}.jpg" for k in range(6)])
    (folder / "times.txt").write_text("".join(f"{k:05d} {100 + 0.05 * k:.6f} 3.5\n" for k in range(6)))
    (folder / "camera.txt").write_text(f"{LENS}\n40 24\ncrop\n40 24\n")
    rows = [f"{100 + 0.05 * k:.6f} 0 0 {k} 0 0 0 1\n" for k in range(3)]
    (folder / "groundtruthSync.txt").write_text("".join(rows) + "100.25 NaN NaN NaN NaN NaN NaN NaN\n")
    return folder


@pytest.mark.parametrize("lens", [LENS, f"FOV {LENS}"])
def test_opens(walk: Path, lens: str) -> None:
    (walk / "camera.txt").write_text(f"{lens}\n40 24\ncrop\n40 24\n")
    assert sequence_kinds(walk) == {"sequence_01": "TUM mono"}
    sequence = open_sequence(walk)
    assert sequence.stamps == pytest.approx(100 + 0.05 * np.arange(6))
    assert (sequence.intrinsics.cx, sequence.intrinsics.cy) == (19.5, 11.5)
    assert sequence.intrinsics.fx / sequence.intrinsics.fy == pytest.approx(20 / 19.2)
    assert sequence.reference is None
    start = open_sequence(walk, frames="0:3").reference
    assert start is not None and start[:, 2, 3] == pytest.approx([0, 1, 2])


def test_the_fov_lens_bends_radii_to_angles() -> None:
    """A ray at 45 degrees, its tangent 1, by the formula of the model; the centre stays."""
    keys = {"width": 200, "height": 100, "fx": 90, "fy": 90, "cx": 99.5, "cy": 49.5, "fps": 10}
    lens = Undistortion(camera_of({**keys, "model": "fov", "distortion": [0.9]}, "here"))
    K = np.array([[50, 0, 99.5], [0, 50, 49.5], [0, 0, 1.0]])
    seen = lens.distort(np.array([[149.5, 49.5], [99.5, 49.5]]), K)
    assert seen[0] == pytest.approx([99.5 + 90 * np.arctan(2 * np.tan(0.45)) / 0.9, 49.5])
    assert seen[1] == pytest.approx([99.5, 49.5])
    stripes = np.zeros((100, 200, 3), np.uint8)
    stripes[:, 100:] = 255
    flat = lens.apply(stripes)
    assert flat[:, :99].max() == 0 and flat[:, 101:].min() == 255


def test_damage(walk: Path) -> None:
    (walk / "camera.txt").write_text("0.5 0.8\n40 24\n")
    with pytest.raises(SequenceError, match=r"camera\.txt needs a row of fx fy cx cy"):
        open_sequence(walk)
    (walk / "camera.txt").write_text(f"{LENS}\n40 24\n")
    (walk / "times.txt").write_text("00000 soon\n" * 6)
    with pytest.raises(SequenceError, match=r"times\.txt, line"):
        open_sequence(walk)
    for path in (walk / "images").iterdir():
        path.unlink()
    with pytest.raises(SequenceError, match=r"unpack images\.zip there"):
        open_sequence(walk)
