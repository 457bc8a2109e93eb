"""Draws, windows, validation, the split of recordings, and split files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from torch import Tensor
from torch.utils.data import DataLoader

from erfsfm.common.errors import DataError
from erfsfm.common.readers.frame_range import overlapping
from erfsfm.config import DataConfig, ExperimentConfig, TeacherConfig
from erfsfm.data.augmentation import FOCAL_LENGTH
from erfsfm.data.discovery import discover
from erfsfm.data.snippets import SnippetDraws, ValidationSnippets
from erfsfm.data.split import Split, read_split_file, split_recordings
from erfsfm.data.window import snippet_motion
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

FRAMES = 9


def experiment(batch: int = 2, sources: int = 2, devices: int = 1, **data: Any) -> ExperimentConfig:
    return ExperimentConfig.model_validate(
        {
            "network": {"height": 32, "width": 48, "sources": sources},
            "data": {"workers": 0, "cache_mb": 10} | data,
            "training": {"batch": batch, "devices": devices},
        }
    )


@pytest.fixture
def coded(tmp_path: Path) -> Path:
    """Folders ``a`` and ``b`` whose frame k is painted 20 k, and the second channel encodes the folder."""
    for code, name in enumerate("ab"):
        folder = tmp_path / name
        folder.mkdir()
        camera = {
            "width": 48,
            "height": 32,
            "fx": 40.0,
            "fy": 41.0,
            "cx": 23.5,
            "cy": 15.5,
            "fps": 10,
        }
        (folder / "camera.yaml").write_text(yaml.safe_dump(camera))
        for index in range(FRAMES):
            image = np.full((32, 48, 3), (0, 200 * code, 20 * index), np.uint8)
            cv2.imwrite(str(folder / f"{index}.png"), image)
    return tmp_path


@pytest.mark.parametrize(
    ("fidelity", "cx"), [("default", 24 * 2 / 3 - 0.5), ("paper", 23.5 * 2 / 3)]
)
def test_samples_have_the_intrinsics_of_their_fidelity(
    coded: Path, fidelity: str, cx: float
) -> None:
    """Images of 48 pixels at a width of 32."""
    config = experiment(flip=0, zoom=1)
    network = config.network.model_copy(update={"width": 32, "fidelity": fidelity})
    config = config.model_copy(update={"network": network})
    recordings = discover(coded / "a")
    for sample in (
        SnippetDraws(recordings, config, 1).draw(0),
        ValidationSnippets(recordings, config)[0],
    ):
        assert float(sample["K"][0, 2]) == pytest.approx(cx)


def test_snippets_with_a_broken_image_are_passed_over_and_others_stay(
    coded: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def drawn() -> list[dict[str, Tensor]]:
        recordings = discover(coded / "a") + discover(coded / "b")
        draws = SnippetDraws(recordings, experiment(flip=0), 40)
        return [draws.draw(number) for number in range(40)]

    before = drawn()
    (coded / "a/4.png").write_bytes(b"broken")
    after = drawn()
    (warning,) = caplog.messages
    assert str(coded / "a/4.png") in warning
    with_it = [folder_of(one) == "a" and 4 in frames_of(one) for one in before]
    assert 3 < sum(with_it) < 20
    assert not any(folder_of(one) == "a" and 4 in frames_of(one) for one in after)
    for one, other in (pair for pair, changed in zip(zip(before, after), with_it) if not changed):
        assert all(torch.equal(one[key], other[key]) for key in one)


def frames_of(sample: dict[str, Tensor]) -> list[int]:
    """Frame numbers in time order of a sample of ``coded``."""
    colours = [*sample["sources"][:, 0].float().mean(dim=(1, 2))]
    colours.insert(len(colours) // 2, sample["target"][0].float().mean())
    return [round(float(c) / 20) for c in colours]


def folder_of(sample: dict[str, Tensor]) -> str:
    return "b" if float(sample["target"][1].float().mean()) > 25 else "a"


def equal(first: dict[str, Tensor], second: dict[str, Tensor]) -> bool:
    return first.keys() == second.keys() and all(
        torch.equal(first[key], second[key]) for key in first
    )


@pytest.mark.parametrize("sources", [2, 4])
def test_windows_are_consecutive_frames_with_the_target_in_the_middle(
    coded: Path, sources: int
) -> None:
    draws = SnippetDraws(discover(coded), experiment(sources=sources), 200)
    starts = set()
    for number in range(200):
        sample = draws.draw(number)
        frames = frames_of(sample)
        assert frames == list(range(frames[0], frames[0] + sources + 1))
        assert sample["target"].shape == (3, 32, 48)
        assert sample["sources"].shape == (sources, 3, 32, 48)
        assert sample["K"].shape == (3, 3)
        assert sample["target"].dtype == sample["sources"].dtype == torch.uint8
        assert sample["K"].dtype == torch.float32
        starts.add((folder_of(sample), frames[0]))
    assert len(starts) == 2 * (FRAMES - sources), "every window of both recordings comes up"


def batches(coded: Path, workers: int, first: int = 0, draws: int = 10) -> list[dict[str, Tensor]]:
    config = experiment(batch=2)
    return list(
        DataLoader(SnippetDraws(discover(coded), config, draws, first), 2, num_workers=workers)
    )


def test_weather_changes_only_the_network_input(coded: Path) -> None:
    clear = SnippetDraws(discover(coded), experiment(), 20)
    wet = SnippetDraws(discover(coded), experiment(weather=0.5), 20)
    changed = 0
    for number in range(20):
        sample, shown = clear.draw(number), wet.draw(number)
        assert "shown" not in sample
        assert all(torch.equal(sample[name], shown[name]) for name in sample)
        seen = shown["shown"]
        assert seen.shape == (3, 3, 32, 48)
        changed += not torch.equal(
            seen, torch.stack([sample["sources"][0], sample["target"], sample["sources"][1]])
        )
    assert 3 <= changed <= 16


def test_resuming_draws_the_same_samples(coded: Path) -> None:
    whole = batches(coded, 0)
    for workers in (0, 2):
        tail = batches(coded, workers, first=6)
        assert len(tail) == 2
        assert all(equal(a, b) for a, b in zip(whole[3:], tail))


@pytest.mark.parametrize("workers", [0, 2])
def test_devices_share_the_draws_of_one_with_a_larger_batch(coded: Path, workers: int) -> None:
    whole = list(DataLoader(SnippetDraws(discover(coded), experiment(batch=4), 16, 4), 4))
    config = experiment(batch=2, devices=2)
    parts = [
        list(DataLoader(SnippetDraws(discover(coded), config, 16, 4, rank), 2, num_workers=workers))
        for rank in (0, 1)
    ]
    assert len(whole) == len(parts[0]) == len(parts[1]) == 3
    for batch, *batches in zip(whole, *parts):
        assert equal(batch, {key: torch.cat([part[key] for part in batches]) for key in batch})


def test_weights_set_the_probabilities(coded: Path) -> None:
    long, short = discover(coded)
    config = experiment(weights={"folder/a": 1, "folder/b": 3})
    draws = SnippetDraws([long, short.part(0, 4)], config, 400)
    counts = Counter(folder_of(draws.draw(number)) for number in range(400))
    assert counts["b"] / 400 == pytest.approx(3 / 4, abs=0.06)


# validation


def test_validation_is_even_and_always_the_same(
    coded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("erfsfm.data.snippets._VALIDATED", 3)
    config = experiment()
    snippets = ValidationSnippets(discover(coded)[:1], config)
    assert [frames_of(snippets[k]) for k in range(len(snippets))] == [
        [0, 1, 2],
        [3, 4, 5],
        [6, 7, 8],
    ]
    assert equal(snippets[1], ValidationSnippets(discover(coded)[:1], config)[1])
    assert set(snippets[0]) == {"target", "sources", "K"}


def test_validation_truth(tmp_path: Path, write_root: Callable[..., Path]) -> None:
    write_root(tmp_path, frames=5, depth=True, step=(0.05, 0.0, 0.1))
    (recording,) = discover(tmp_path)
    sample = ValidationSnippets([recording.part(0, 5)], experiment(sources=4))[0]
    assert sample["depth"].shape == (64, 96), "at its stored size"
    assert float(sample["depth"][3, 3]) == pytest.approx(6 - 0.2, abs=1 / 256)
    T_source_target = sample["T_source_target"]
    assert T_source_target.shape == (4, 4, 4)
    steps = torch.tensor([2, 1, -1, -2]).double()  # target minus source
    torch.testing.assert_close(T_source_target[:, 0, 3], 0.05 * steps)
    torch.testing.assert_close(T_source_target[:, 2, 3], 0.1 * steps)


# the split of recordings


def names(config: DataConfig) -> tuple[list[str], list[str]]:
    training, validation = split_recordings(config)
    return [r.frames_name for r in training], [r.frames_name for r in validation]


@pytest.fixture
def kitti(tmp_path: Path, write_root: Callable[..., Path]) -> Path:
    return write_root(tmp_path / "kitti", frames=6, sequences=("00", "03", "09", "10"), size=(8, 8))


def test_test_sequences_are_never_trained_on(kitti: Path) -> None:
    assert names(DataConfig(roots=[kitti])) == (["kitti_odometry/00[0:6]"], [])


def test_a_misspelt_kind_is_not_left_in_the_training(kitti: Path) -> None:
    with pytest.raises(DataError, match=r"data\.exclude names 'simulatd/3'"):
        split_recordings(DataConfig(roots=[kitti], exclude=["simulatd/3"]))


def test_ranges_and_parts_that_are_excluded(kitti: Path) -> None:
    """The frames around such a part train."""
    training, _ = names(DataConfig(roots=[kitti], ranges={"kitti_odometry/00": "1:4"}, exclude=[]))
    assert training[0] == "kitti_odometry/00[1:4]" and len(training) == 4
    held_back = [
        "kitti_raw/2011_10_03_drive_0027[2:4]",
        "kitti_odometry/03",
        "kitti_odometry/09",
        "kitti_odometry/10",
    ]
    config = DataConfig(roots=[kitti], exclude=held_back)
    assert names(config)[0] == ["kitti_odometry/00[0:2]", "kitti_odometry/00[4:6]"]
    config = DataConfig(roots=[kitti], exclude=held_back, ranges={"kitti_odometry/00": "0:3"})
    assert names(config)[0] == ["kitti_odometry/00[0:2]"]


def test_validation_recordings_only_validate(
    tmp_path: Path, write_root: Callable[..., Path]
) -> None:
    for seed in (499, 500, 599):
        write_root(tmp_path / str(seed), frames=2, seed=seed, size=(8, 8))
    training, validation = names(DataConfig(roots=[tmp_path]))
    assert training == ["simulated/499[0:2]"]
    assert validation == ["simulated/500[0:2]", "simulated/599[0:2]"]


@pytest.fixture
def raw(tmp_path: Path, write_raw: Callable[..., Path]) -> Path:
    """A drive to train on, one of Eigen's scenes, and the drives of the odometry sequences 00 (a scene too) and 09."""
    for drive in (
        "09_26_drive_0001",
        "09_26_drive_0005",
        "09_26_drive_0013",
        "10_03_drive_0027",
        "09_30_drive_0033",
    ):
        write_raw(tmp_path / "raw", drive=f"2011_{drive}", speeds=[9, 9, 9, 0, 9, 9], size=(16, 24))
    return tmp_path / "raw"


def drives(config: DataConfig) -> tuple[set[str], set[str]]:
    training, validation = split_recordings(config)
    return {r.name[-10:] for r in training}, {r.name[-10:] for r in validation}


def test_eigens_scenes_and_test_sequences_are_left_out(raw: Path) -> None:
    assert drives(DataConfig(roots=[raw])) == ({"drive_0001", "drive_0005"}, set())
    everything = DataConfig(roots=[raw], exclude=[])
    assert drives(everything)[0] == {
        "drive_0001",
        "drive_0005",
        "drive_0013",
        "drive_0027",
        "drive_0033",
    }
    assert "drive_0033" not in drives(DataConfig(roots=[raw], exclude=["kitti_odometry/09"]))[0]


def test_static_frames_are_left_out(raw: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        training, _ = names(
            DataConfig(roots=[raw], exclude=["kitti_raw/2011_09_26_drive_0005", "eigen"])
        )
    assert training[:2] == [
        "kitti_raw/2011_09_26_drive_0001[0:3]",
        "kitti_raw/2011_09_26_drive_0001[4:6]",
    ]
    assert "4 of 24 frames" in caplog.text


def test_the_odometry_split(tmp_path: Path, write_root: Callable[..., Path]) -> None:
    root = write_root(
        tmp_path, frames=3, sequences=("00", "03", "06", "09", "10", "11"), size=(8, 8)
    )
    training, validation = names(
        DataConfig(roots=[root], split="odometry", validation=[], exclude=[])
    )
    assert training == ["kitti_odometry/00[0:3]", "kitti_odometry/03[0:3]"]
    assert validation == ["kitti_odometry/06[0:3]"]


def test_exact_labels_of_a_snippet_and_its_mirror_image(tmp_path: Path) -> None:
    """True motion and depth in camera heights, of a camera of the reference focal length."""
    street = SimulatedStreet(SimulationOptions("straight", 6, 1, 96, 64))
    write_kitti_root(street, tmp_path, depth=True)
    (recording,) = discover(tmp_path)
    config = experiment(sources=2, zoom=1.0).model_copy(
        update={"teacher": TeacherConfig(structure_weight=1)}
    )
    straight, mirrored = (
        SnippetDraws(
            [recording],
            config.model_copy(update={"data": config.data.model_copy(update={"flip": flip})}),
            4,
        ).draw(0)
        for flip in (0.0, 1.0)
    )
    height, width = straight["target"].shape[-2:]
    nearer = recording.camera.resized(width, height).fy / height / FOCAL_LENGTH
    poses = street.T_world_camera
    motions = [snippet_motion(poses, first, 2) for first in range(len(poses) - 2)]
    unit = street.camera_height_m * nearer
    T_source_target = straight["T_source_target"].numpy()
    assert any(
        np.allclose(T_source_target[:, :3, 3] * unit, T[:, :3, 3], atol=1e-4) for T in motions
    )
    known = straight["least"] > 0
    assert (
        torch.equal(straight["least"][known], straight["most"][known])
        and known.float().mean() > 0.5
    )
    for name in ("least", "most", "target"):
        torch.testing.assert_close(mirrored[name], straight[name].flip(-1))
    signs = torch.tensor([-1.0, 1, 1])
    torch.testing.assert_close(
        mirrored["T_source_target"][:, :3, 3], straight["T_source_target"][:, :3, 3] * signs
    )


def test_exact_labels_are_wanted_of_every_recording(
    tmp_path: Path, write_root: Callable[..., Path]
) -> None:
    config = experiment(sources=2).model_copy(update={"teacher": TeacherConfig(structure_weight=1)})
    with pytest.raises(DataError, match=r"kitti_odometry/00 has none: simulate with --depth"):
        SnippetDraws(discover(write_root(tmp_path, 6)), config, draws=4)


def test_the_end_of_each_recording_that_is_long_enough_is_kept_to_validate_on(
    tmp_path: Path, write_root: Callable[..., Path]
) -> None:
    write_root(tmp_path / "long", 50, ("01",), size=(32, 48))
    write_root(tmp_path / "short", 20, ("04",), size=(32, 48))
    config = DataConfig(
        roots=[tmp_path / "long", tmp_path / "short"], validation=[], validation_share=0.4
    )
    training, validation = split_recordings(config)
    assert [each.frames_name for each in training] == [
        "kitti_odometry/01[0:30]",
        "kitti_odometry/04[0:20]",
    ]
    assert [each.frames_name for each in validation] == ["kitti_odometry/01[30:50]"]
    with pytest.raises(
        DataError, match=r"validation_share 0\.4 leaves fewer than 20 frames of .*/04 \(20 frames\)"
    ):
        split_recordings(config.model_copy(update={"roots": [tmp_path / "short"]}))


@pytest.mark.parametrize(("name", "count"), [("eigen", 61), ("odometry", 11)])
def test_nothing_is_in_two_lists(name: str, count: int) -> None:
    split = read_split_file(name)
    assert split.train and split.validation
    assert overlapping([*split.train, *split.validation], split.test_recordings) == []
    assert overlapping(split.train, split.validation) == []
    everything = [*split.train, *split.validation, *split.test_recordings]
    assert len(set(everything)) == len(everything) == count


@pytest.mark.parametrize(
    ("runs", "frames"),
    [
        ("3", [3]),
        ("0:3", [0, 1, 2]),
        ("0:7:3", [0, 3, 6]),
        ("0:7:3, 9,11:13", [0, 3, 6, 9, 11, 12]),
    ],
)
def test_runs(runs: str, frames: list[int]) -> None:
    assert Split(test=[f"kitti_raw/a[{runs}]"]).test_frames() == [
        ("kitti_raw/a", frame) for frame in frames
    ]
