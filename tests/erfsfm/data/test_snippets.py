"""Draws, windows, validation, and labels: exact depth, and depth of a network as the label of another one."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig, TeacherConfig
from erfsfm.data import many_view_teacher
from erfsfm.data.augmentation import FOCAL_LENGTH
from erfsfm.data.discovery import INDOOR_HEIGHT_M, discover
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.snippets import FARTHEST_M, SnippetDraws, ValidationSnippets, chances, stacked
from erfsfm.data.split import split_recordings
from erfsfm.data.window import HEIGHTS, snippet_motion
from erfsfm.inference import DepthPosePredictor, learned_inverse_depth
from erfsfm.model_record import find_weights, read_record
from erfsfm.training.run import prepare, train
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet

CAMERA = "width: 48\nheight: 32\nfx: 40\nfy: 41\ncx: 23.5\ncy: 15.5\nfps: 10\n"
FRAMES = 9
SIZE = (64, 96)


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
        (folder / "camera.yaml").write_text(CAMERA)
        for index in range(FRAMES):
            image = np.full((32, 48, 3), (0, 200 * code, 20 * index), np.uint8)
            cv2.imwrite(str(folder / f"{index}.png"), image)
    return tmp_path


@pytest.mark.parametrize(
    ("fidelity", "cx"), [("default", 24 * 2 / 3 - 0.5), ("paper", 23.5 * 2 / 3)]
)
def test_samples_have_the_intrinsics_of_their_fidelity(coded, fidelity, cx):
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


def test_snippets_with_a_broken_image_are_passed_over_and_others_stay(coded, caplog):
    def drawn() -> list[dict[str, Tensor]]:
        recordings = discover(coded / "a") + discover(coded / "b")
        draws = SnippetDraws(recordings, experiment(flip=0), 40)
        return [draws.draw(number) for number in range(40)]

    before = drawn()
    (coded / "a/4.png").write_bytes(b"broken")
    after = drawn()
    (warning,) = set(caplog.messages)
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
def test_windows_are_consecutive_frames_with_the_target_in_the_middle(coded, sources):
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


def test_weather_changes_only_the_network_input(coded):
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


def test_what_a_mask_hides_comes_with_every_sample(coded):
    mask = np.full((32, 48), 255, np.uint8)
    mask[24:] = 0
    cv2.imwrite(str(coded / "a" / "mask.png"), mask)
    with (coded / "a" / "camera.yaml").open("a") as file:
        file.write("mask: mask.png\n")
    recordings = discover(coded)
    assert {len(each) for each in recordings} == {FRAMES}  # the mask is no frame
    draws = SnippetDraws(recordings, experiment(zoom=1.0), 20)
    for sample in map(draws.draw, range(20)):
        is_masked = folder_of(sample) == "a"
        assert sample["fixed"].shape == (1, 32, 48)
        assert bool(sample["fixed"][0, 24:].all()) == is_masked
        assert not sample["fixed"][0, :23].any()


def test_a_camera_that_has_to_be_found_is_found_by_one_run(coded, monkeypatch, caplog):
    asked = []

    def slam(words: list[str]) -> str:
        asked.append(words[0])
        scene = Path(words[words.index("--output") + 1])
        shutil.copytree(coded / "a", scene, dirs_exist_ok=True)
        (scene / "camera.yaml").write_text(f"{CAMERA}source: it is 40 px")
        return "no road" if "auto,height=2" in words else ""

    monkeypatch.setattr(many_view_teacher, "slam_process", slam)
    config = experiment(roots=[str(coded / "b")], validation=[]).data
    for _ in range(2):
        (found,), _ = split_recordings(config, Path("auto"), coded / "teacher")
    assert asked == ["run", "export"] and caplog.messages == [f"{coded / 'b'}: it is 40 px"]
    assert found.name == "folder/b" and found.images[0].is_relative_to(coded / "teacher")
    with pytest.raises(DataError, match=r"camera of .*b could not be found: no road"):
        split_recordings(config, Path("auto,height=2"), coded / "teacher")


def test_resuming_draws_the_same_samples(coded):
    whole = batches(coded, 0)
    for workers in (0, 2):
        tail = batches(coded, workers, first=6)
        assert len(tail) == 2
        assert all(equal(a, b) for a, b in zip(whole[3:], tail))


@pytest.mark.parametrize("workers", [0, 2])
def test_devices_share_the_draws_of_one_with_a_larger_batch(coded, workers):
    whole = list(DataLoader(SnippetDraws(discover(coded), experiment(batch=4), 16, 4), 4))
    config = experiment(batch=2, devices=2)
    parts = [
        list(DataLoader(SnippetDraws(discover(coded), config, 16, 4, rank), 2, num_workers=workers))
        for rank in (0, 1)
    ]
    assert len(whole) == len(parts[0]) == len(parts[1]) == 3
    for batch, *batches in zip(whole, *parts):
        assert equal(batch, {key: torch.cat([part[key] for part in batches]) for key in batch})


def test_weights_set_the_probabilities(coded):
    long, short = discover(coded)
    config = experiment(weights={"folder/a": 1, "folder/b": 3})
    draws = SnippetDraws([long, short.part(0, 4)], config, 400)
    counts = Counter(folder_of(draws.draw(number)) for number in range(400))
    assert counts["b"] / 400 == pytest.approx(3 / 4, abs=0.06)


# validation


def test_validation_is_even_and_always_the_same(coded, monkeypatch):
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


def test_validation_truth(tmp_path, write_root):
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


def test_exact_labels_of_a_snippet_and_its_mirror_image(tmp_path):
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


def test_exact_labels_are_wanted_of_every_recording(tmp_path, write_root):
    config = experiment(sources=2).model_copy(update={"teacher": TeacherConfig(structure_weight=1)})
    with pytest.raises(DataError, match=r"kitti_odometry/00 has none: simulate with --depth"):
        SnippetDraws(discover(write_root(tmp_path, 6)), config, draws=4)


# single images with their true depth as the label


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exact") / "world"
    write_kitti_root(
        SimulatedStreet(SimulationOptions("straight", 6, 1, 96, 64, varied=True)),
        folder,
        depth=True,
    )
    return folder


@pytest.fixture
def mixed(
    world: Path, write_root: Callable[..., Path], tmp_path: Path
) -> Callable[..., ExperimentConfig]:
    """An experiment on the world and a real drive, half exact."""
    real = write_root(tmp_path / "real", 12)

    def build(roots: tuple[Path, ...] = (world, real), **data: Any) -> ExperimentConfig:
        sections: dict[str, Any] = {
            "network": {
                "height": SIZE[0],
                "width": SIZE[1],
                "sources": 2,
                "depth_width": 0.1,
                "pose_width": 0.1,
            },
            "data": {
                "workers": 0,
                "flip": 0,
                "zoom": 1,
                "exact": 0.5,
                "validation": [],
                "roots": list(roots),
            }
            | data,
            "loss": {"smoothness": "disparity-edge-aware", "smoothness_weight": 0.001},
            "teacher": {
                "views": "many",
                "structure_weight": 1,
                "edge_weight": 1,
                "cache": tmp_path / "measured",
            },
            "training": {"networks": "depth", "batch": 4, "steps": 1},
        }
        return ExperimentConfig.model_validate(sections)

    return build


def test_the_label_is_the_inverse_depth_in_camera_heights(world, mixed, measure):
    config = mixed()
    measure(config, lambda *_: 0.25)
    recordings, _ = split_recordings(config.data)
    teacher = ManyViewTeacher(config.teacher.cache, SIZE, config.teacher.stride)  # type: ignore[arg-type]
    sample = SnippetDraws(recordings, config, 8, many_views=teacher).draw(0)
    recording = next(each for each in recordings if each.exact)
    height_m = SimulatedStreet(
        SimulationOptions("straight", 6, 1, 96, 64, varied=True)
    ).camera_height_m
    assert recording.camera_height_m == pytest.approx(height_m)
    images = [recording.image(index, *SIZE) for index in range(len(recording))]
    shown = sample["target"].permute(1, 2, 0).numpy()
    index = next(k for k, image in enumerate(images) if np.array_equal(image, shown))
    depth_m = recording.true_depth(index)
    assert depth_m is not None
    nearer = recording.camera.fy / SIZE[0] / FOCAL_LENGTH
    wanted = torch.from_numpy(
        height_m / np.where(depth_m > 0, depth_m, FARTHEST_M) * nearer
    ).float()
    torch.testing.assert_close(sample["most"][0], wanted)
    known = torch.from_numpy(depth_m > 0)
    torch.testing.assert_close(sample["least"][0], torch.where(known, wanted, 0))


def test_a_batch_begins_with_its_share_of_single_images(mixed, measure):
    config = mixed()
    measure(config, lambda *_: 0.25)
    recordings, _ = split_recordings(config.data)
    teacher = ManyViewTeacher(config.teacher.cache, SIZE, config.teacher.stride)  # type: ignore[arg-type]
    draws = SnippetDraws(recordings, config, 8, many_views=teacher)
    for batch in DataLoader(draws, 4, collate_fn=stacked):
        assert len(batch["target"]) == len(batch["least"]) == len(batch["K"]) == 4
        assert len(batch["sources"]) == len(batch["T_source_target"]) == 2
    singles = ["sources" not in draws.draw(number) for number in range(8)]
    assert singles == [True, True, False, False] * 2


def test_a_prepared_folder_trains_without_the_worlds(mixed, measure, tmp_path):
    config = mixed()
    measure(config, lambda *_: 0.25)
    prepare(config, tmp_path / "prepared")
    original, again = (
        SnippetDraws(split_recordings(c.data)[0], c, 4)
        for c in (config, mixed((tmp_path / "prepared",)))
    )
    for number in range(2):
        one, other = original.draw(number), again.draw(number)
        torch.testing.assert_close(
            other["least"], one["least"], msg="exact depth of the same pixels"
        )
    train(mixed((tmp_path / "prepared",)), tmp_path / "run", device="cpu")
    assert read_record(tmp_path / "run" / "model.yaml").trained_on == [
        "simulated/1",
        "kitti_odometry/00[0:12]",
    ]


@pytest.mark.parametrize("where", [".", "images"])
def test_a_depth_camera_is_exact_and_what_it_does_not_see_may_be_anywhere(
    mixed, tmp_path, caplog, where
):
    folder = tmp_path / "office"
    (folder / "depth").mkdir(parents=True)
    (folder / "images").mkdir()
    depth = np.full((64, 96), 2000, np.uint16)  # millimetres
    depth[:32] = 0
    for index in range(6):
        cv2.imwrite(
            str(folder / "images" / f"{index:06d}.png"), np.full((64, 96, 3), 30 * index, np.uint8)
        )
        cv2.imwrite(str(folder / "depth" / f"{index:06d}.png"), depth)
    camera = "width: 96\nheight: 64\nfx: 90\nfy: 90\ncx: 48\ncy: 32\nfps: 5\n"
    (folder / where / "camera.yaml").write_text(camera)
    with pytest.raises(DataError, match="add depth_per_metre"):
        discover(folder)
    (folder / where / "camera.yaml").write_text(camera + "depth_per_metre: 1000\n")
    config = mixed((folder, tmp_path / "real"), weights={"folder": 1, "kitti": 1})
    recordings, _ = split_recordings(config.data)
    draws = SnippetDraws(
        recordings, config, 8, imitated=lambda image: np.ones(image.shape[:2], np.float32)
    )
    sample = draws.draw(0)
    nearer = 90 / SIZE[0] / FOCAL_LENGTH
    assert torch.isinf(sample["most"][0, :32]).all()
    torch.testing.assert_close(
        sample["least"][0, 32:], torch.full((32, 96), INDOOR_HEIGHT_M / 2 * nearer)
    )
    (folder / "depth" / "000003.png").unlink()
    assert not discover(folder)[0].exact
    assert "000003.png" in caplog.text


def test_worlds_are_drawn_by_their_weight(world, mixed):
    (recording,) = discover(world)
    twice = [recording, replace(recording, name="folder/office")]
    np.testing.assert_allclose(chances(twice, [1, 1], {"simulated": 9, "folder": 1}), [0.9, 0.1])
    with pytest.raises(ValueError, match="less than one sample"):
        mixed(exact=0.2)


# depth of a network as the label of another one


def imitation(root: Path) -> ExperimentConfig:
    """An experiment on one drive that imitates the depth of ``sim``."""
    tree: dict[str, dict[str, Any]] = {
        "teacher": {"views": "network", "slam_weights": "sim", "structure_weight": 1},
        "network": {"height": 32, "width": 48, "sources": 2, "depth_width": 0.1, "pose_width": 0.1},
        "data": {"workers": 0, "flip": 1, "zoom": 1, "validation": [], "roots": [root]},
        "loss": {"photometric_weight": 0, "smoothness_weight": 0},
        "training": {"networks": "depth", "batch": 2, "steps": 1},
    }
    return ExperimentConfig.model_validate(tree)


def test_the_label_is_what_the_network_gives_for_the_larger_image(write_root, tmp_path):
    config = imitation(write_root(tmp_path / "real", 3))
    (recording,), _ = split_recordings(config.data)
    seen = []

    def imitated(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        seen.append(image)
        return learned_inverse_depth("sim", image)

    draws = SnippetDraws([recording], config, 1, imitated=imitated)
    sample = draws.draw(0)
    stored = recording.image(1, 64, 96)
    depth = DepthPosePredictor.from_weights("sim", "cpu", "onnx").depth(stored)
    disparity = 1 / depth[:, ::-1]  # every image is mirrored
    torch.testing.assert_close(sample["least"], sample["most"])
    wanted = torch.from_numpy(disparity.reshape(32, 2, 48, 2).mean((1, 3)))[None] / HEIGHTS
    torch.testing.assert_close(sample["most"], wanted, rtol=2e-3, atol=1e-4)
    torch.testing.assert_close(draws.draw(0)["most"], sample["most"], rtol=0, atol=0)
    assert len(seen) == 1, "the label is kept"


def test_it_trains_depth_alone(write_root, tmp_path):
    output = train(imitation(write_root(tmp_path / "real", 5)), tmp_path / "run", device="cpu")
    assert (output / "last" / "depth.safetensors").is_file()
    assert not (output / "last" / "pose.safetensors").exists()
    record = read_record(output / "last" / "model.yaml")
    assert set(read_record(find_weights("sim") / "model.yaml").trained_on) <= set(record.trained_on)
