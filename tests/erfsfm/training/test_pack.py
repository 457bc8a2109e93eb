"""A pack trains in place of the data that it was made from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from erfsfm.common.errors import ConfigError, DataError
from erfsfm.config import ExperimentConfig, TeacherConfig
from erfsfm.data.discovery import discover
from erfsfm.data.snippets import ValidationSnippets, split_recordings
from erfsfm.training.pack import pack
from erfsfm.training.run import train, trained_on

Small = dict[str, dict[str, Any]]
SIZE, STRIDE = (32, 64), 3


@pytest.fixture
def roots(tmp_path: Path, write_root: Callable[..., Path]) -> list[Path]:
    """Twelve real frames, three worlds of ten to twenty, and one to validate on."""
    real = write_root(tmp_path / "kitti", frames=12, step=(0.0, 0.0, 0.05))
    worlds = [
        write_root(tmp_path / f"world{n}", frames=10 + 5 * n, seed=n, step=(0.0, 0.0, 0.05 + n / 100)) for n in range(3)
    ]
    return [real, *worlds, write_root(tmp_path / "held_out", frames=9, seed=500, depth=True)]


@pytest.fixture
def config(small: Small, roots: list[Path], measure: Callable[..., None], tmp_path: Path) -> ExperimentConfig:
    """Of a training by many views, measured already."""
    data = {"roots": roots, "validation": ["simulated/500"], "validation_snippets": 3, "exclude": []}
    teacher = {"views": "many", "stride": STRIDE, "structure_weight": 1.0, "translation_weight": 1.0}
    tree = small | {
        "data": small["data"] | data | {"ranges": {"kitti_odometry/00": "2:11"}},
        "teacher": teacher | {"cache": tmp_path / "measured"},
        "loss": {"photometric_weight": 0.0},
    }
    config = ExperimentConfig.model_validate(tree)
    measure(config, lambda recording, target: (1 + recording.start + target) / 100)
    return config


def on_pack(config: ExperimentConfig, output: Path) -> ExperimentConfig:
    return config.model_copy(update={"data": config.data.model_copy(update={"roots": [output]})})


def test_validation_is_on_the_same_snippets_with_their_truth(config: ExperimentConfig, tmp_path: Path) -> None:
    pack(config, tmp_path / "pack")
    _, held_out = split_recordings(config.data)
    _, packed = split_recordings(on_pack(config, tmp_path / "pack").data)
    original, again = ValidationSnippets(held_out, config), ValidationSnippets(packed, config)
    assert len(original) == len(again) == 3
    for one, other in zip(original, again):
        assert one.keys() == other.keys() >= {"depth", "T_source_target"}
        torch.testing.assert_close(other["T_source_target"], one["T_source_target"])
        assert torch.equal(other["depth"], one["depth"])


def test_images_that_cannot_be_read_are_left_out(
    config: ExperimentConfig, roots: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for frame in (5, 8):
        (roots[0] / f"sequences/00/image_2/{frame:06d}.png").write_bytes(b"no image")
    config = config.model_copy(update={"teacher": TeacherConfig()})
    done = pack(config, tmp_path / "pack")
    assert done.frames == 3 + 45  # 2 to 4; 6 and 7, 9 and 10 are no snippet
    assert "2 of 54 images cannot be read; 6 are left out" in caplog.text and "000005.png" in caplog.text
    packed = split_recordings(on_pack(config, tmp_path / "pack").data)[0]
    assert trained_on(packed) == ["simulated/0-2", "kitti_odometry/00[2:5]"]
    for image in sorted(roots[0].rglob("image_2/*.png"))[:-1]:
        image.write_bytes(b"no image")
    data = config.data.model_copy(update={"roots": roots[:1], "validation": []})
    config = config.model_copy(update={"data": data})
    with pytest.raises(DataError, match=r"no 3 consecutive images can be read: image .*000002\.png"):
        pack(config, tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_what_is_there_is_never_overwritten(config: ExperimentConfig, tmp_path: Path) -> None:
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "thesis.txt").touch()
    with pytest.raises(ConfigError, match="is not empty: choose a new folder"):
        pack(config, tmp_path / "pack")


def test_a_pack_that_fails_leaves_nothing(
    config: ExperimentConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr("erfsfm.training.pack.write_index", fail)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(OSError, match="the disk is full"):
        pack(config, tmp_path / "pack")
    assert sorted(tmp_path.iterdir()) == before


def test_measurements_need_a_place(config: ExperimentConfig, tmp_path: Path) -> None:
    nowhere = config.model_copy(update={"teacher": config.teacher.model_copy(update={"cache": None})})
    with pytest.raises(ConfigError, match=r"--set teacher\.cache=FOLDER"):
        pack(nowhere, tmp_path / "pack")


def test_drives_without_a_teacher_keep_their_stops_out(
    small: Small, write_raw: Callable[..., Path], tmp_path: Path
) -> None:
    drive = write_raw(tmp_path / "raw", drive="2011_10_03_drive_0099", speeds=[5] * 6 + [0] * 3 + [5] * 6)
    tree = small | {"data": small["data"] | {"roots": [drive], "exclude": []}}
    config = ExperimentConfig.model_validate(tree)
    done = pack(config, tmp_path / "pack")
    assert (done.frames, done.labels) == (24, 0)
    names = [recording.frames_name for recording in discover(tmp_path / "pack")]
    assert names == [f"kitti_raw/2011_10_03_drive_0099{frames}" for frames in ("[0:6]", "[9:15]") * 2]
    train(on_pack(config, tmp_path / "pack"), tmp_path / "run", device="cpu")
