import subprocess
import sys
from pathlib import Path

import pytest

from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence, sequence_kinds, sequence_names


def test_only_sequence_needs_no_name(tmp_path: Path, odometry) -> None:
    odometry(tmp_path, name="07")
    assert open_sequence(tmp_path, None, None, None).name == "07"


def test_several_sequences_are_listed(tmp_path: Path, odometry) -> None:
    for name in ("02", "10", "00"):
        odometry(tmp_path, name=name, frames=2)
    assert sequence_names(tmp_path) == ["00", "02", "10"]
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
    assert sequence_names(tmp_path) == ["00"]
    with pytest.raises(SequenceError, match=r"no images in .*09: looked for .*image_2.*; found calib\.txt"):
        open_sequence(tmp_path, "09", None, None)


def test_environment(tmp_path: Path, odometry, monkeypatch: pytest.MonkeyPatch) -> None:
    odometry(tmp_path / "kitti", name="09")
    monkeypatch.chdir(tmp_path)
    for dataset in (None, Path("KITTI")):
        with pytest.raises(SequenceError, match=r"sequence 09 is looked for in \$KITTI_ODOMETRY, which is not set"):
            open_sequence(dataset, "09", None, None)
    monkeypatch.setenv("KITTI_ODOMETRY", str(tmp_path / "kitti"))
    assert open_sequence(None, "09", None, None).name == "09"
    assert open_sequence(Path("KITTI"), "09", None, None).name == "09"
    assert open_sequence(Path("KITTI"), None, None, None).name == "09"
    monkeypatch.setenv("KITTI_ODOMETRY", str(tmp_path / "nowhere"))
    with pytest.raises(SequenceError, match=r"no data set at .*nowhere \(\$KITTI_ODOMETRY\)"):
        open_sequence(None, "09", None, None)


@pytest.mark.parametrize(
    "content, message",
    [
        ([], "is no data set: .*found an empty folder"),
        (["a.txt", "b.txt"], "is no data set: looked for .*found a.txt, b.txt"),
        (["sequences/00/calib.txt"], "no sequence with images under .*sequences.*found 00"),
        ([f"{k}.txt" for k in range(12)], "and 4 more"),
        (["2011_09_26_drive_0013_extract/x"], "is no data set"),
    ],
)
def test_unknown_folders(tmp_path: Path, content: list[str], message: str) -> None:
    for name in content:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    with pytest.raises(SequenceError, match=message):
        open_sequence(tmp_path, None, None, None)


def test_unknown_paths(tmp_path: Path, camera_yaml: str) -> None:
    with pytest.raises(SequenceError, match=r"no data set at .*nowhere: check the path"):
        open_sequence(tmp_path / "nowhere", None, None, None)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(SequenceError, match=r"notes\.txt is no video \(mp4, avi, mov, mkv\)"):
        open_sequence(tmp_path / "notes.txt", None, None, None)
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    with pytest.raises(SequenceError, match="without a data set"):
        open_sequence(None, None, tmp_path / "camera.yaml", None)


def test_name_of_a_folder_inside(tmp_path: Path, images, camera_yaml: str) -> None:
    images(tmp_path / "mine", ["0.png", "1.png"])
    (tmp_path / "mine" / "camera.yaml").write_text(camera_yaml)
    assert open_sequence(tmp_path, "mine", None, None).name == "mine"
    assert open_sequence(tmp_path / "mine", "mine", None, None).name == "mine"
    with pytest.raises(SequenceError, match=r"no sequence yours in .*found mine"):
        open_sequence(tmp_path / "mine", "yours", None, None)


def test_the_door_is_light() -> None:
    code = (
        "import sys, slam.sequences.catalogue; "
        "print([m for m in ('torch', 'gtsam', 'open3d', 'evo') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


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
