"""Which camera file belongs to a sequence."""

from pathlib import Path

import pytest

from slam.errors import SequenceError
from slam.sequences.camera_file import find_camera_file


def written(folder: Path, text: str) -> Path:
    (folder / "camera.yaml").write_text(text)
    return folder / "camera.yaml"


def test_search_order(tmp_path: Path, camera_yaml: str) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    with pytest.raises(SequenceError, match=r"no camera\.yaml for images: looked in .*inner and "):
        find_camera_file(None, inner, tmp_path, wanted_by="images")
    written(tmp_path, camera_yaml)
    assert find_camera_file(None, inner, tmp_path, wanted_by="images").fps == 5
    written(inner, camera_yaml.replace("fps: 5", "fps: 6"))
    assert find_camera_file(None, inner, tmp_path, wanted_by="images").fps == 6
    assert find_camera_file(tmp_path / "camera.yaml", inner, wanted_by="images").fps == 5
    with pytest.raises(SequenceError, match=r"no camera file .*nowhere\.yaml"):
        find_camera_file(tmp_path / "nowhere.yaml", inner, wanted_by="images")
