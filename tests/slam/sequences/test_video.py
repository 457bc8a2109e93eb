from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.errors import SequenceError
from slam.sequences.catalogue import open_sequence


def write_video(path: Path) -> Path:
    """Ninety black frames but for number 12, which is white."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for k in range(90):
        writer.write(np.full((48, 64, 3), 255 * (k == 12), np.uint8))
    writer.release()
    return path


@pytest.fixture
def camera_64(camera_yaml: str) -> str:
    return camera_yaml.replace("width: 40", "width: 64").replace("height: 24", "height: 48")


@pytest.mark.parametrize("by_folder", [False, True])
def test_opens(tmp_path: Path, camera_64: str, by_folder: bool) -> None:
    path = write_video(tmp_path / "trip" / "drive.avi")
    (tmp_path / "trip" / "camera.yaml").write_text(camera_64)
    sequence = open_sequence(tmp_path / "trip" if by_folder else path, None, None, "10:20")
    assert (sequence.name, len(sequence)) == ("drive", 10)
    assert [bool(sequence.frame(k).image.mean() > 200) for k in range(1, 4)] == [False, True, False]
    assert sequence.stamps[0] == pytest.approx(2.0)
    assert sequence.provenance() == ("folder/trip[10:20]",)


def test_errors(tmp_path: Path, camera_64: str, camera_yaml: str) -> None:
    path = write_video(tmp_path / "drive.avi")
    with pytest.raises(SequenceError, match=r"no camera\.yaml for video .*drive\.avi"):
        open_sequence(path, None, None, None)
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    with pytest.raises(SequenceError, match="are 64x48, but the camera file is for 40x24"):
        open_sequence(path, None, None, None)
    (tmp_path / "camera.yaml").write_text(camera_64)
    write_video(tmp_path / "other.avi")
    with pytest.raises(SequenceError, match="has 2 sequences: drive, other"):
        open_sequence(tmp_path, None, None, None)
    path.write_bytes(b"not a video")
    with pytest.raises(SequenceError, match=r"drive\.avi cannot be opened"):
        open_sequence(path, None, None, None)
