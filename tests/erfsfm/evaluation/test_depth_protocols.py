"""The protocols of depth with oracle networks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig
from erfsfm.data.discovery import discover, named_recordings
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.evaluation import depth_protocols
from erfsfm.evaluation.depth_protocols import (
    TRUTH_FOLDER,
    depth_protocol,
    many_view_protocol,
    refined_protocol,
)
from erfsfm.evaluation.streets import EVERY
from erfsfm.training.run import prepare
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet

STEP = (0.05, 0.0, 0.1)
HEIGHT_M = 1.65


class Flat:
    """A depth of 3 everywhere."""

    sources = 4

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.full(image.shape[:2], 3.0, np.float32)

    def leaks(self, names: list[str]) -> list[str]:
        return [name for name in names if name.startswith("kitti_odometry/")]


class Slanted(Flat):
    """Depth that grows to the right."""

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return super().depth(image) * np.linspace(1, 2, image.shape[1], dtype=np.float32)


def test_depth(tmp_path: Path, write_root: Callable[..., Path]):
    write_root(tmp_path, frames=11, depth=True, seed=600, step=STEP)
    networks, median = depth_protocol({"networks": Flat()}, [tmp_path], allow_leak=False)
    assert networks["images"] == 3, "every fifth frame"
    assert networks["abs_rel"] == pytest.approx(0, abs=1e-3)
    assert networks["scale"] == pytest.approx(np.mean([6.0, 5.5, 5.0]) / 3, abs=1e-3)
    assert networks["scale_spread"] == pytest.approx(np.std([6.0, 5.5, 5.0]) / 5.5, abs=1e-3)
    assert median["method"] == "median depth map"


def test_refined_depth_of_pairs_with_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A run of each street against all of the truth, what stands and what moves; too short a street is left out."""
    for folder in ("images", "truth", "moving", "calib"):
        (tmp_path / folder).mkdir()
    truth, moves = np.full((20, 40), 2560, np.uint16), np.zeros((20, 40), np.uint8)
    moves[:5] = 255
    for name in ("a_000000", "a_000001", "b_000000"):
        cv2.imwrite(str(tmp_path / f"images/{name}.png"), np.zeros((20, 40, 3), np.uint8))
        cv2.imwrite(str(tmp_path / f"truth/{name}.png"), truth)
        cv2.imwrite(str(tmp_path / f"moving/{name}.png"), moves)
        (tmp_path / f"calib/{name}.txt").write_text("30 30 20 10 40 20")

    def run(words: list[str]) -> str:
        sequence = Path(words[words.index("--dataset") + 1]) / "sequences" / "00"
        maps = sorted((sequence / "depth_2").iterdir())
        assert len(maps) == len(list((sequence / "image_2").iterdir()))
        assert (sequence / "calib.txt").read_text().startswith("P2: 30.0 0 20.0")
        if len(maps) == 1:
            return "too short"
        share = float((cv2.imread(str(maps[0]), cv2.IMREAD_UNCHANGED) > 0).mean())
        errors = {"abs_rel": share, "median_rel": 0.1, "coverage": {"90": 0.9}, "frames": 2}
        refined = errors | {"by_range": {"5-10": share}}
        output = Path(words[words.index("--output") + 1])
        output.mkdir()
        depth = {"network": {"abs_rel": 0.5}, "refined": refined}
        (output / "metrics.json").write_text(json.dumps({"depth": depth}))
        return ""

    monkeypatch.setattr(depth_protocols, "slam_process", run)
    mean, *rows = refined_protocol(Flat(), "default", [tmp_path], allow_leak=False)
    names = [row["street"].removeprefix(f"folder/{tmp_path.name}/") for row in rows]
    assert names == ["a", "a static", "a moving"]
    assert [row["refined"] for row in rows] == [1.0, 0.75, 0.25]
    assert (mean["streets"], mean["refined"], mean["learned"]) == (1, 1.0, 0.5)
    (tmp_path / "calib" / "b_000000.txt").write_text("30 30")
    with pytest.raises(DataError, match=r"b_000000\.txt must hold fx fy cx cy"):
        refined_protocol(Flat(), "default", [tmp_path], allow_leak=False)


def test_depth_of_a_pack(
    tmp_path: Path, write_root: Callable[..., Path], small: dict[str, dict[str, object]]
):
    """It holds smaller images than depth maps, and depth of the middle of each snippet alone."""
    roots = [write_root(tmp_path / "seen", frames=3, seed=1)]
    roots += [write_root(tmp_path / "held_out", frames=11, depth=True, seed=500, step=STEP)]
    data = {"roots": roots, "validation": ["simulated/500"]}
    prepare(ExperimentConfig.model_validate(small | {"data": data}), tmp_path / "prepared")
    networks, _ = depth_protocol({"networks": Flat()}, [tmp_path / "prepared"], allow_leak=False)
    assert networks["images"] == 9
    assert networks["abs_rel"] == pytest.approx(0, abs=1e-3)


def write_pairs(root: Path, street: str, farther: list[bool]) -> None:
    """Images with four known depths: 10 m, and one of 20 m where ``farther``, which makes an AbsRel of 0.125."""
    for folder in ("images", "truth"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for index, with_far in enumerate(farther):
        cv2.imwrite(
            str(root / "images" / f"{street}_{index:06d}.jpg"), np.zeros((64, 96, 3), np.uint8)
        )
        truth = np.zeros((64, 96), np.uint16)
        truth[[40, 40, 50, 50], [40, 50, 40, 50]] = 2560
        truth[50, 50] *= 1 + with_far
        truth[2, 2] = 60 * 256  # outside the crop
        cv2.imwrite(str(root / "truth" / f"{street}_{index:06d}.png"), truth)


def test_streets_count_alike_and_have_standard_errors(tmp_path: Path):
    write_pairs(tmp_path / "pairs", "06", [True] * 5 + [False] * 5)
    write_pairs(tmp_path / "pairs", "08", [False] * 20)
    rows = depth_protocol({"networks": Flat()}, [tmp_path / "pairs"], allow_leak=False)
    mean, first, second = rows
    assert [row["street"] for row in (first, second)] == ["folder/pairs/06", "folder/pairs/08"]
    assert [row["images"] for row in rows] == [30, 10, 20]
    assert first["abs_rel"] == pytest.approx(0.0625)
    assert second["abs_rel"] == 0
    assert mean["abs_rel"] == mean["abs_rel_se"] == pytest.approx(0.0625 / 2), "not by their images"
    assert first["abs_rel_se"] is None and first["abs_rel_se_reason"] == "one street"
    assert mean["a1"] == pytest.approx((1 - 0.25 / 2 + 1) / 2)


def test_a_picture_of_each_street_shows_image_depths_and_truth(tmp_path: Path):
    write_pairs(tmp_path / "pairs", "06", [True, False])
    networks = {"a": Flat(), "b": Slanted()}
    depth_protocol(networks, [tmp_path / "pairs"], allow_leak=False, pictures=tmp_path / "pictures")
    (file,) = (tmp_path / "pictures").iterdir()
    assert file.name == "folder-pairs-06.jpg"
    image, flat, slanted, truth = np.split(cv2.imread(str(file)).astype(int).sum(axis=2), 4)
    assert image.max() < 30 and np.ptp(flat) < 30
    assert slanted[:, 0].mean() > slanted[:, -1].mean() + 100, "near is bright"
    assert truth[40, 40] > truth[50, 50] + 100 > truth[20, 20] + 200, "unknown is dark"


def test_networks_are_compared_street_by_street(tmp_path: Path):
    write_pairs(tmp_path / "pairs", "06", [True] * 4)
    write_pairs(tmp_path / "pairs", "08", [True, False])
    mean, other, *single = depth_protocol(
        {"a": Flat(), "b": Slanted()}, [tmp_path / "pairs"], allow_leak=False
    )
    assert "ratio" not in mean
    assert [(row["method"], row["street"][-2:]) for row in single] == [
        ("a", "06"),
        ("b", "06"),
        ("a", "08"),
        ("b", "08"),
    ]
    ratios = [single[1]["ratio"], single[3]["ratio"]]
    assert ratios[0] == pytest.approx(single[1]["abs_rel"] / single[0]["abs_rel"])
    assert other["ratio"] == pytest.approx(np.sqrt(np.prod(ratios)))
    assert other["ratio_se"] == pytest.approx(
        other["ratio"] * abs(np.log(ratios[0] / ratios[1])) / 2
    )


def test_drives_with_lidar_and_worlds_are_streets(
    tmp_path: Path, write_drive: Callable[..., Path], write_root: Callable[..., Path]
):
    roots = [
        write_drive(tmp_path / "raw"),
        write_root(tmp_path / "world", frames=11, depth=True, seed=600),
    ]
    rows = depth_protocol({"networks": Flat()}, roots, allow_leak=False)  # type: ignore[arg-type]
    assert [row.get("street") for row in rows] == [
        None,
        "kitti_raw/2011_09_26_drive_0099",
        "simulated/600",
    ]
    assert [row["images"] for row in rows] == [5, 2, 3], "every fifth frame"
    assert rows[0]["abs_rel"] == pytest.approx(0, abs=1e-3)
    assert rows[0]["abs_rel_se"] == pytest.approx(0, abs=1e-3)


def test_a_leak_of_one_street_is_refused(tmp_path: Path, write_root: Callable[..., Path]):
    write_pairs(tmp_path / "pairs", "06", [True])
    roots = [tmp_path / "pairs", write_root(tmp_path / "kitti", frames=2, depth=True)]
    with pytest.raises(DataError, match=r"leak: .* kitti_odometry/00\[0:2\]"):
        depth_protocol({"networks": Flat()}, roots, allow_leak=False)  # type: ignore[arg-type]
    rows = depth_protocol({"networks": Flat()}, roots, allow_leak=True)  # type: ignore[arg-type]
    assert [row["leak"] for row in rows] == [True, False, True]


class Networks:
    """True depth in another scale, or the same depth everywhere."""

    sources = 4

    def __init__(self, recording, right):
        self._images = [recording.image(i, 128, 416).tobytes() for i in range(len(recording))]
        self._recording, self._right = recording, right
        self.seen = []

    def depth(self, image):
        if not self._right:
            return np.ones(image.shape[:2], np.float32)
        true = self._recording.true_depth(self._images.index(image.tobytes()))
        return np.where(true > 0, true, 1e3).astype(np.float32) / 7

    def poses(self, images):
        raise AssertionError("not asked for")

    def leaks(self, names):
        return self.seen


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    root = tmp_path_factory.mktemp("world") / "world"
    street = SimulatedStreet(
        SimulationOptions(frames=13, seed=707, route="straight", width=416, height=128)
    )
    write_kitti_root(street, root, depth=True)
    return root


@pytest.fixture(scope="module")
def cache(world, tmp_path_factory):
    """The drive's poses as a run would leave them, so that none is needed."""
    folder, recording = tmp_path_factory.mktemp("cache"), discover(world)[0]
    T_world_camera = recording.true_poses().copy()
    T_world_camera[:, :3, 3] /= HEIGHT_M
    ManyViewTeacher(folder / TRUTH_FOLDER, (128, 416), EVERY).drive(recording).keep_poses(
        T_world_camera
    )
    return folder


def rows_of(networks, world, cache, sequences=(), allow_leak=False):
    recordings = [part for name in sequences or [""] for part in named_recordings(world, name)]
    return many_view_protocol(networks, recordings, cache, allow_leak, lambda *_: None)


def test_true_depth_is_right_and_constant_depth_is_wrong(world, cache):
    recording = discover(world)[0]
    (right,) = rows_of(Networks(recording, right=True), world, cache)
    (wrong,) = rows_of(Networks(recording, right=False), world, cache)
    assert right["images"] == wrong["images"] == 2, (
        "every fifth frame that has two neighbours on either side"
    )
    assert right["abs_rel"] < 0.08 < 0.2 < wrong["abs_rel"]
    assert 0.3 < right["known"] == wrong["known"] < 1
    assert right["recording"] == "simulated/707[0:13]" and right["leak"] is False


def test_leaks_and_recordings_that_are_not_there_are_refused(world, cache):
    networks = Networks(discover(world)[0], right=False)
    with pytest.raises(DataError, match="no sequence 7"):
        rows_of(networks, world, cache, ["7"])
    networks.seen = ["simulated/707"]
    with pytest.raises(DataError, match="leak"):
        rows_of(networks, world, cache)
    (row,) = rows_of(networks, world, cache, allow_leak=True)
    assert row["leak"] is True
