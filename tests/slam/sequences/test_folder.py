from pathlib import Path

import numpy as np
import pytest

from slam.errors import SequenceError
from slam.sequences.catalogue import open_sequence


@pytest.mark.parametrize("inner", ["", "images", "data"])
@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jpeg", ".bmp"])
def test_layouts(tmp_path: Path, images, camera_yaml: str, inner: str, beside: bool, suffix: str) -> None:
    folder = tmp_path / "drive"
    images(folder / inner, [f"f{k}{suffix}" for k in range(12)])
    ((tmp_path if beside else folder) / "camera.yaml").write_text(camera_yaml)
    (folder / "ins.txt").write_text("ignored")
    sequence = open_sequence(folder, None, None, None)
    assert (sequence.name, len(sequence)) == ("drive", 12)
    assert sequence.frame(11).image[0, 0, 0] == pytest.approx(110, abs=2)
    assert sequence.stamps == pytest.approx(np.arange(12) / 5)
    assert sequence.reference is None and sequence.camera_height_m is None
    assert sequence.provenance() == ("folder/drive[0:12]",)


def test_inner_folder_has_the_outer_name(tmp_path: Path, images, camera_yaml: str) -> None:
    images(tmp_path / "drive" / "images", ["0.png", "1.png"])
    (tmp_path / "drive" / "camera.yaml").write_text(camera_yaml + "camera_height_m: 1.4\n")
    sequence = open_sequence(tmp_path / "drive" / "images", None, None, "1:")
    assert sequence.name == "drive" and sequence.camera_height_m == 1.4
    assert sequence.provenance() == ("folder/drive[1:2]",)


def test_undistorts(tmp_path: Path, images, camera_yaml: str) -> None:
    images(tmp_path, ["0.png", "1.png"])
    (tmp_path / "camera.yaml").write_text(camera_yaml + "model: opencv\ndistortion: [-0.2, 0, 0, 0]\n")
    sequence = open_sequence(tmp_path, None, None, None)
    assert sequence.intrinsics.fx < 30 and (sequence.frame(1).image == 10).all()


def test_errors(tmp_path: Path, images, camera_yaml: str) -> None:
    folder = tmp_path / "drive"
    images(folder / "images", ["0.png", "1.png", "2.png", "4.png"])
    with pytest.raises(SequenceError, match=r"no image 3\.png"):
        (folder / "camera.yaml").write_text(camera_yaml)
        open_sequence(folder, None, None, None)
    (folder / "images/4.png").unlink()
    (folder / "camera.yaml").write_text(camera_yaml.replace("width: 40", "width: 44"))
    with pytest.raises(SequenceError, match="are 40x24, but the camera file is for 44x24"):
        open_sequence(folder, None, None, None)
    (folder / "camera.yaml").unlink()
    with pytest.raises(SequenceError, match=r"no camera\.yaml for images in .*images"):
        open_sequence(folder, None, None, None)
    images(folder / "data", ["0.png"])
    with pytest.raises(SequenceError, match="has images in images, data"):
        open_sequence(folder, None, None, None)
