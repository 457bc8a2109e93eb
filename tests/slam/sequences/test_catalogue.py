import subprocess
import sys
from pathlib import Path

import pytest

from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence, sequence_kinds


def test_several_sequences_are_listed(tmp_path: Path, odometry) -> None:
    for name in ("02", "10", "00"):
        odometry(tmp_path, name=name, frames=2)
    assert list(sequence_kinds(tmp_path)) == ["00", "02", "10"]
    with pytest.raises(SequenceError, match="has 3 sequences: 00, 02, 10; choose one with --sequence"):
        open_sequence(tmp_path, None, None, None)
    with pytest.raises(SequenceError) as caught:
        open_sequence(tmp_path, "09", None, None)
    assert str(caught.value) == (
        f"no sequence 09 in {tmp_path}: found 00, 02, 10 under {tmp_path / 'sequences'}; "
        "choose one of them with --sequence"
    )


def test_sequence_without_images_says_so(tmp_path: Path, odometry) -> None:
    odometry(tmp_path)
    (tmp_path / "sequences/09").mkdir()
    (tmp_path / "sequences/09/calib.txt").write_text("")
    assert list(sequence_kinds(tmp_path)) == ["00"]
    with pytest.raises(SequenceError, match=r"no images in .*09: looked for .*image_2"):
        open_sequence(tmp_path, "09", None, None)


def test_name_of_a_folder_inside(tmp_path: Path, images, camera_yaml: str) -> None:
    images(tmp_path / "mine", ["0.png", "1.png"])
    (tmp_path / "mine" / "camera.yaml").write_text(camera_yaml)
    assert open_sequence(tmp_path, "mine", None, None).name == "mine"
    assert open_sequence(tmp_path / "mine", "mine", None, None).name == "mine"
    with pytest.raises(SequenceError, match=r"no sequence yours in .*found mine"):
        open_sequence(tmp_path / "mine", "yours", None, None)


def test_the_door_is_light() -> None:
    code = "import sys, slam.sequences.catalogue; print({'torch', 'gtsam', 'open3d', 'evo'} & sys.modules.keys())"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "set()"


def test_a_folder_of_recordings_lists_all(tmp_path: Path, images, odometry, camera_yaml: str) -> None:
    images(tmp_path / "left", ["0.png"])
    images(tmp_path / "right/images", ["0.png"])
    odometry(tmp_path / "kitti", name="03", frames=2)
    odometry(tmp_path / "kitti", name="04", frames=2)
    (tmp_path / "2011_09_26_drive_0013_extract").mkdir()  # refused where it is given, here it is only left out
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    kinds = {"kitti/03": "KITTI odometry", "kitti/04": "KITTI odometry", "left": "images", "right": "images"}
    assert sequence_kinds(tmp_path) == kinds
    for name in kinds:
        assert len(open_sequence(tmp_path, name)) == 1 + ("kitti" in name)
    with pytest.raises(SequenceError, match="has 4 sequences: kitti/03, kitti/04, left, right; choose one"):
        open_sequence(tmp_path)
