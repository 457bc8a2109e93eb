"""Single images with their true depth as the label, and depth of a network as the label of another one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig
from erfsfm.data.augmentation import FOCAL_LENGTH
from erfsfm.data.discovery import INDOOR_HEIGHT_M, discover
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.snippets import FARTHEST_M, SnippetDraws, chances, stacked
from erfsfm.data.split import split_recordings
from erfsfm.data.window import HEIGHTS
from erfsfm.inference import DepthPosePredictor, learned_inverse_depth
from erfsfm.model_record import find_weights, read_record
from erfsfm.training.run import prepare, train
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions
from slam.simulation.rooms import SimulatedRooms
from slam.simulation.street import SimulatedStreet

SIZE = (64, 96)


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


def test_rooms_are_exact_in_a_unit_of_their_own(tmp_path: Path) -> None:
    rooms = SimulatedRooms(SimulationOptions("rooms", 2, 0, 64, 48))
    write_kitti_root(rooms, tmp_path / "rooms", depth=True)
    (recording,) = discover(tmp_path / "rooms")
    assert recording.exact
    assert recording.camera_height_m == INDOOR_HEIGHT_M


def test_the_label_is_the_inverse_depth_in_camera_heights(
    world: Path, mixed: Callable[..., ExperimentConfig], measure: Callable[..., None]
) -> None:
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


def test_a_batch_begins_with_its_share_of_single_images(
    mixed: Callable[..., ExperimentConfig], measure: Callable[..., None]
) -> None:
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


def test_a_prepared_folder_trains_without_the_worlds(
    mixed: Callable[..., ExperimentConfig], measure: Callable[..., None], tmp_path: Path
) -> None:
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
    mixed: Callable[..., ExperimentConfig],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    where: str,
) -> None:
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


def test_worlds_are_drawn_by_their_weight(
    world: Path, mixed: Callable[..., ExperimentConfig]
) -> None:
    (recording,) = discover(world)
    twice = [recording, replace(recording, name="folder/office")]
    np.testing.assert_allclose(chances(twice, [1, 1], {"simulated": 9, "folder": 1}), [0.9, 0.1])
    with pytest.raises(ValueError, match="less than one sample"):
        mixed(exact=0.2)


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


def test_the_label_is_what_the_network_gives_for_the_larger_image(
    write_root: Callable[..., Path], tmp_path: Path
) -> None:
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


def test_it_trains_depth_alone(write_root: Callable[..., Path], tmp_path: Path) -> None:
    output = train(imitation(write_root(tmp_path / "real", 5)), tmp_path / "run", device="cpu")
    assert (output / "last" / "depth.safetensors").is_file()
    assert not (output / "last" / "pose.safetensors").exists()
    record = read_record(output / "last" / "model.yaml")
    assert set(read_record(find_weights("sim") / "model.yaml").trained_on) <= set(record.trained_on)
