"""Which camera file belongs to a sequence."""

from pathlib import Path

import pytest

from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import find_camera_file

IMAGES = Intrinsics(40, 24, 30, 30, 20, 12)


def written(folder: Path, text: str) -> Path:
    (folder / "camera.yaml").write_text(text)
    return folder / "camera.yaml"


def test_search_order(tmp_path: Path, camera_yaml: str) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    with pytest.raises(SequenceError, match=r"no camera\.yaml for images: looked in .*inner and "):
        find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES)
    written(tmp_path, camera_yaml)
    assert find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES).fps == 5
    written(inner, camera_yaml.replace("fps: 5", "fps: 6"))
    assert find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES).fps == 6
    assert find_camera_file(tmp_path / "camera.yaml", inner, wanted_by="images", images=IMAGES).fps == 5
    with pytest.raises(SequenceError, match=r"no camera file .*nowhere\.yaml"):
        find_camera_file(tmp_path / "nowhere.yaml", inner, wanted_by="images", images=IMAGES)


def test_a_horizontal_field_of_view_is_a_camera(tmp_path: Path) -> None:
    camera = find_camera_file(Path("fov=90"), tmp_path, wanted_by="images", images=IMAGES)
    assert (camera.width, camera.height, camera.fps) == (40, 24, 10)
    assert camera.fx == camera.fy == pytest.approx(20)  # half the width of 40 pixels at 45 degrees
    assert (camera.cx, camera.cy) == (19.5, 11.5)
    assert find_camera_file(Path("fov=90,fps=25"), tmp_path, wanted_by="images", images=IMAGES, fps=30).fps == 25
    assert find_camera_file(Path("fov=90"), tmp_path, wanted_by="images", images=IMAGES, fps=30).fps == 30
