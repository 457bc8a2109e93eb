"""Errors by every source of truth: the exact street, depth maps on disk, LiDAR scans; and reasons where none is."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.images import read_depth_map
from slam.config.sections import ScaleMode
from slam.frames import Intrinsics, Sequence
from slam.frontend.scale import LengthUnit, Scale, ScaleEstimate
from slam.geometry.se3 import FloatArray, apply
from slam.mapping.depth import KeyframeDepth
from slam.results.metrics import MapMetrics
from slam.results.truth_errors import DepthQuality, find_truth, map_errors, projected, true_depth
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence
from slam.sequences.recording import RecordedSequence, Source
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence, write_kitti_root

OPTIONS = SimulationOptions("straight", frames=14, seed=702, width=312, height=96)
CAMERA = Intrinsics(8, 6, 5.0, 5.0, 3.5, 2.5)
DEPTH = np.full((6, 8), 5.0, np.float32)


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
    for k, T_world_camera in enumerate(
        embedded.reference if embedded.reference is not None else ()
    ):
        depth = embedded.true_depth(k)
        seen = (camera.rays(camera.pixel_grid()) * depth[..., None])[(depth > 0) & (depth < 20)]
        points.append(apply(T_world_camera, seen[::3]))
    return np.concatenate(points)


def errors(
    points: FloatArray, sequence: Sequence, mode: ScaleMode = "camera-height", scale: float = 1.0
) -> dict[str, Any]:
    """Errors of a map in the world of the true poses, all lengths divided by ``scale``."""
    unit: LengthUnit = "camera heights" if mode == "none" else "metres"
    T_world_camera = sequence.reference.copy()
    T_world_camera[:, :3, 3] /= scale
    result = SimpleNamespace(
        optimised=SimpleNamespace(T_world_camera=T_world_camera),
        scale=Scale(mode, ScaleEstimate(1.0, 0.0, 9), np.ones(1), {}, unit, {}),
    )
    return MapMetrics.of(
        **map_errors(lambda: iter(np.array_split(points / scale, 3)), result, sequence)
    ).tree()


def test_true_depth_at_true_poses_has_no_error(
    embedded: SimulatedSequence, on_disk: Path, true_map: FloatArray
):
    exact, measured = errors(true_map, embedded), errors(true_map, open_sequence(on_disk))
    assert (exact["truth"], measured["truth"]) == ("exact surface", "depth maps")
    assert exact["accuracy_90_m"] < 1e-3 and measured["accuracy_90_m"] < 0.04
    for found in (exact, measured):
        assert found["completeness"] > 0.97 and found["f_score"]["0.2"] > 0.97
        assert found["in_field"]["share"] == 1.0
        assert found["evaluated_m"] == pytest.approx(14.8, abs=0.1)


def test_scans_are_a_truth(on_disk: Path, true_map: FloatArray):
    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps = {}
    found = errors(true_map, sequence)
    assert found["truth"] == "lidar"
    assert found["in_field"]["accuracy_median_m"] < 0.08
    assert 0.3 < found["in_field"]["share"] < 1.0
    assert found["in_field"]["precision"]["0.5"] > found["precision"]["0.5"]
    assert found["completeness"] > 0.9


def test_scans_that_cannot_be_read_measure_nothing(on_disk: Path, true_map: FloatArray):
    def cut_off() -> FloatArray:
        raise SequenceError("the scan is cut off")

    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps, sequence.scans[5] = {}, cut_off
    assert errors(true_map, sequence)["completeness"] > 0.9
    sequence.scans = dict.fromkeys(sequence.scans, cut_off)
    found = errors(true_map, sequence)
    assert found["completeness"] is None and found["completeness_reason"]


def test_an_excerpt_has_the_truth_of_its_own_frames(embedded: SimulatedSequence, on_disk: Path):
    for sequence in (embedded.cut(4, 12), open_sequence(on_disk, frames="4:12")):
        camera = sequence.intrinsics
        depth = embedded.true_depth(9)
        seen = (camera.rays(camera.pixel_grid()) * depth[..., None])[(depth > 0) & (depth < 15)]
        found = errors(apply(sequence.reference[5], seen), sequence)
        assert found["accuracy_median_m"] < 0.03


def test_one_scale_is_fitted_apart(on_disk: Path, true_map: FloatArray):
    sequence = open_sequence(on_disk)
    found = errors(true_map, sequence, scale=1.1)
    assert found["accuracy_median_m"] > 0.1
    assert (
        found["with_scale"]["scale"] == pytest.approx(1.1)
        and found["with_scale"]["accuracy_median_m"] < 0.03
    )
    unknown = errors(true_map, sequence, mode="none", scale=1.65)
    assert (
        unknown["accuracy_median_m"] is None and "with_scale" in unknown["accuracy_median_m_reason"]
    )
    assert unknown["with_scale"]["accuracy_median_m"] < 0.03


def test_without_truth_every_number_has_a_reason(on_disk: Path):
    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps, sequence.scans = {}, {}
    found = errors(np.zeros((5, 3)), sequence)
    missing = [key for key in found if not key.endswith("_reason")]
    assert all(
        found[key] is None and "neither depth maps nor LiDAR" in found[f"{key}_reason"]
        for key in missing
    )
    sequence.reference = None
    assert find_truth(sequence) == "the sequence has no true poses"


def test_a_damaged_depth_map_costs_the_error_of_the_map_and_no_more(
    on_disk: Path, true_map: FloatArray
):
    sequence = open_sequence(on_disk)
    assert isinstance(sequence, RecordedSequence)
    sequence.depth_maps[3] = partial(read_depth_map, on_disk / "camera.yaml")
    found = errors(true_map, sequence)
    assert found["accuracy_median_m"] is None and "camera.yaml" in found["accuracy_median_m_reason"]


def recorded(**more: Any) -> RecordedSequence:
    images = type("Images", (), {"width": 8, "height": 6, "__len__": lambda self: 4})()
    return RecordedSequence("a", images, CAMERA, np.arange(4.0), (Source("a"),), **more)


def keyframe(refined: bool = True) -> KeyframeDepth:
    image = np.zeros((6, 8, 3), np.uint8)
    sigma = np.full_like(DEPTH, 0.1)
    sigma[0] = 0.3
    if not refined:
        return KeyframeDepth(2, DEPTH, None, image, np.eye(4))
    return KeyframeDepth(2, DEPTH * 1.1, sigma, image, np.eye(4), DEPTH)


def with_depth(tmp_path: Path) -> RecordedSequence:
    path = tmp_path / "000002.png"
    cv2.imwrite(str(path), (DEPTH * 256).astype(np.uint16))
    return recorded(depth_maps={2: partial(read_depth_map, path)})


def test_stored_depth_is_read_and_compared(tmp_path: Path):
    quality = DepthQuality(with_depth(tmp_path), is_metric=True)
    quality.add(keyframe())
    summary = quality.metrics(is_refined=True).tree()
    assert summary["network"]["abs_rel"] == 0
    assert abs(summary["refined"]["abs_rel"] - 0.1) < 1e-4
    assert summary["refined"]["coverage"].keys() == {"50", "90", "95"}


def test_an_excerpt_reads_the_frame_of_its_base(tmp_path: Path):
    excerpt = with_depth(tmp_path).cut(2, 4)
    np.testing.assert_allclose(true_depth(excerpt, 0), DEPTH)
    assert true_depth(excerpt, 1) is None


def test_a_depth_map_that_cannot_be_read_is_left_out_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    sequence = with_depth(tmp_path)
    (tmp_path / "000002.png").write_bytes(b"x")
    quality = DepthQuality(sequence, is_metric=True)
    for _ in range(2):
        quality.add(keyframe())
    assert quality.metrics(True).network.absent == "the true depth of 2 keyframes cannot be read"
    assert len(caplog.messages) == 1 and "000002.png" in caplog.messages[0]


def test_every_missing_number_has_its_reason(tmp_path: Path):
    def reasons(
        metric: bool, sequence: RecordedSequence, *keyframes: KeyframeDepth, is_refined: bool = True
    ):
        quality = DepthQuality(sequence, metric)
        for one in keyframes:
            quality.add(one)
        summary = quality.metrics(is_refined).tree()
        return summary.get("network_reason"), summary.get("refined_reason")

    known = with_depth(tmp_path)
    assert "mapping.enabled" in reasons(True, known)[0]
    assert "no true depth" in reasons(True, recorded(), keyframe())[1]
    assert "not in metres" in reasons(False, known, keyframe())[0]
    assert reasons(True, known, keyframe(False)) == (
        None,
        "no keyframe has a neighbour at a useful distance",
    )
    assert reasons(True, known, keyframe(False), is_refined=False) == (None, "depth.refine is none")


def test_the_nearest_lidar_point_of_a_pixel_counts():
    depth = projected(np.array([[0.1, 0.1, 4.0], [0.2, 0.2, 8.0], [0, 0, -3.0]]), np.eye(4), CAMERA)
    assert depth[3, 4] == 4.0 and (depth > 0).sum() == 1
