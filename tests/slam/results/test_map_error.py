"""Map errors of every source of truth: the exact street, depth maps on disk, LiDAR scans; and reasons where none is."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.config.sections import ScaleMode
from slam.frames import Sequence
from slam.frontend.scale.metric_scale import LengthUnit, Scale
from slam.frontend.scale.scale_estimate import ScaleEstimate
from slam.geometry.se3 import FloatArray, apply
from slam.results.map_error import find_truth, map_errors
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence
from slam.sequences.images import read_depth_map
from slam.sequences.recording import RecordedSequence
from slam.sequences.simulated import SimulatedSequence
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions

OPTIONS = SimulationOptions("straight", frames=24, seed=702, width=312, height=96)


@pytest.fixture(scope="module")
def embedded() -> SimulatedSequence:
    return SimulatedSequence(OPTIONS)


@pytest.fixture(scope="module")
def on_disk(embedded: SimulatedSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same street as files, with depth maps and scans."""
    root = tmp_path_factory.mktemp("simulated") / "root"
    write_kitti_root(embedded.street, root, depth=True, lidar=True)
    return root


@pytest.fixture(scope="module")
def true_map(embedded: SimulatedSequence) -> FloatArray:
    """True depth at true poses, as far as 20 m."""
    camera, points = embedded.intrinsics, []
    for k, T_world_camera in enumerate(embedded.reference if embedded.reference is not None else ()):
        depth = embedded.true_depth(k)
        seen = (camera.rays(camera.pixel_grid()) * depth[..., None])[(depth > 0) & (depth < 20)]
        points.append(apply(T_world_camera, seen[::3]))
    return np.concatenate(points)


def errors(
    points: FloatArray, sequence: Sequence, mode: ScaleMode = "camera-height", scale: float = 1.0
) -> dict[str, Any]:
    """Errors of a map in the world of the true poses, all lengths divided by ``scale``."""
    unit: LengthUnit = "camera heights" if mode == "none" else "metres"
    assert sequence.reference is not None
    T_world_camera = sequence.reference.copy()
    T_world_camera[:, :3, 3] /= scale
    result = SimpleNamespace(
        optimised=SimpleNamespace(T_world_camera=T_world_camera),
        scale=Scale(mode, ScaleEstimate(1.0, 0.0, 9), np.ones(1), {}, unit),
    )
    return map_errors(lambda: iter(np.array_split(points / scale, 3)), result, sequence).tree()


def test_true_depth_at_true_poses_has_no_error(
    embedded: SimulatedSequence, on_disk: Path, true_map: FloatArray
) -> None:
    exact, measured = errors(true_map, embedded), errors(true_map, open_sequence(on_disk))
    assert (exact["truth"], measured["truth"]) == ("exact surface", "depth maps")
    assert exact["accuracy_90_m"] < 1e-3 and measured["accuracy_90_m"] < 0.04
    for found in (exact, measured):
        assert found["completeness"] > 0.97 and found["f_score"]["0.2"] > 0.97
        assert found["in_field"]["share"] == 1.0
        assert found["evaluated_m"] == pytest.approx(26.8, abs=0.1)


def test_scans_are_a_truth(on_disk: Path, true_map: FloatArray) -> None:
    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps = {}
    found = errors(true_map, sequence)
    assert found["truth"] == "lidar"
    assert found["in_field"]["accuracy_median_m"] < 0.08
    assert 0.3 < found["in_field"]["share"] < 1.0
    assert found["in_field"]["precision"]["0.5"] > found["precision"]["0.5"]
    assert found["completeness"] > 0.9


def test_scans_that_cannot_be_read_measure_nothing(on_disk: Path, true_map: FloatArray) -> None:
    def cut_off() -> FloatArray:
        raise SequenceError("the scan is cut off")

    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps, sequence.scans[5] = {}, cut_off
    assert errors(true_map, sequence)["completeness"] > 0.9
    sequence.scans = dict.fromkeys(sequence.scans, cut_off)
    found = errors(true_map, sequence)
    assert found["completeness"] is None and found["completeness_reason"]


def test_an_excerpt_has_the_truth_of_its_own_frames(embedded: SimulatedSequence, on_disk: Path) -> None:
    for sequence in (embedded.cut(10, 20), open_sequence(on_disk, frames="10:20")):
        camera = sequence.intrinsics
        depth = embedded.true_depth(15)
        seen = (camera.rays(camera.pixel_grid()) * depth[..., None])[(depth > 0) & (depth < 15)]
        assert sequence.reference is not None
        found = errors(apply(sequence.reference[5], seen), sequence)
        assert found["accuracy_median_m"] < 0.03


def test_one_scale_is_fitted_apart(on_disk: Path, true_map: FloatArray) -> None:
    sequence = open_sequence(on_disk)
    found = errors(true_map, sequence, scale=1.1)
    assert found["accuracy_median_m"] > 0.1
    assert found["with_scale"]["scale"] == pytest.approx(1.1) and found["with_scale"]["accuracy_median_m"] < 0.03
    unknown = errors(true_map, sequence, mode="none", scale=1.65)
    assert unknown["accuracy_median_m"] is None and "with_scale" in unknown["accuracy_median_m_reason"]
    assert unknown["with_scale"]["accuracy_median_m"] < 0.03


def test_without_truth_every_number_has_a_reason(on_disk: Path) -> None:
    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps, sequence.scans = {}, {}
    found = errors(np.zeros((5, 3)), sequence)
    missing = [key for key in found if not key.endswith("_reason")]
    assert all(found[key] is None and "neither depth maps nor LiDAR" in found[f"{key}_reason"] for key in missing)
    sequence.reference = None
    assert find_truth(sequence) == "the sequence has no true poses"


def test_a_damaged_depth_map_costs_the_error_of_the_map_and_no_more(on_disk: Path, true_map: FloatArray) -> None:
    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps[3] = partial(read_depth_map, on_disk / "camera.yaml")
    found = errors(true_map, sequence)
    assert found["accuracy_median_m"] is None and "camera.yaml" in found["accuracy_median_m_reason"]
