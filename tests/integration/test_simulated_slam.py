"""The whole system on the simulated street with its exact ground truth: with an oracle, then with the shipped networks.

Errors may be twice what was measured; the measured figure is the other factor of each limit.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor, ate

from slam import run_slam
from slam.config.sections import load_config
from slam.evaluation.map import pose_similarity
from slam.formats.trajectory import read_trajectory
from slam.frontend.visual.odometry import ESSENTIAL_SOURCE
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import SlamPipeline
from slam.runtime.errors import Failed
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence, write_kitti_root

FACTOR = 0.2  # unscaled lengths per metre
NOISE = {
    "rotation_sigma": np.deg2rad(0.3),
    "translation_relative_sigma": 0.05,
    "depth_relative_sigma": 0.03,
}


class Rendered(SimulatedSequence):
    """The street, its depth beside it."""

    def depth(self, index: int) -> FloatArray:
        """True z-depth, the sky at 200 m."""
        depth = self.street.depth(self.start + index).astype(np.float64)
        return np.where(depth > 0, depth, 200.0)


@pytest.fixture(scope="module")
def street() -> Rendered:
    return Rendered(SimulationOptions("loop", frames=250, seed=1000, width=416, height=128))


def drive(sequence: Rendered, seed: int, *overrides: str) -> Estimate:
    assert sequence.reference is not None
    oracle = OraclePredictor(
        sequence.reference, sequence.depth, OracleNoise(**NOISE, seed=seed), FACTOR
    )
    return SlamPipeline(sequence, oracle, load_config(None, overrides)).run()


@pytest.fixture(scope="module")
def round_trip(street: Rendered) -> Estimate:
    """Once around the block with everything on."""
    return drive(street, 0)


@pytest.mark.slow
def test_image_geometry_and_graph_reduce_the_error_of_the_network(round_trip: Estimate):
    assert len(round_trip.optimised) == 250
    sources = [motion.relative_pose.source for motion in round_trip.drive.steps.values()]
    assert sources.count(ESSENTIAL_SOURCE) > 200
    assert ate(round_trip, "network") == pytest.approx(
        0.94, rel=0.2
    )  # chained from snippets that touch
    assert ate(round_trip, "odometry") < 2 * 0.64
    assert ate(round_trip) < 2 * 0.109


@pytest.mark.slow
def test_the_camera_height_gives_metres(round_trip: Estimate):
    estimate = round_trip.scale.estimate
    assert round_trip.scale.mode == "camera-height" and not isinstance(estimate, Failed)
    assert estimate.value * FACTOR == pytest.approx(1.0, rel=0.03)
    assert estimate.frames_used > 200
    assert round_trip.optimised.length_m == pytest.approx(round_trip.reference.length_m, rel=0.03)


@pytest.mark.slow
def test_the_map_lies_on_the_street(street: Rendered, round_trip: Estimate):
    assert round_trip.map is not None and round_trip.reference is not None
    points = round_trip.map.cloud().points[::7]
    assert len(points) > 10_000
    fit = pose_similarity(round_trip.reference.T_world_camera, round_trip.optimised.T_world_camera)
    points = fit.scale * points @ fit.R_a_b.T + fit.t_a_b
    distance = street.street.distance_to_surface(points)
    assert np.median(distance) < 2 * 0.034
    assert np.percentile(distance, 90) < 2 * 0.20


@pytest.mark.slow
def test_without_noise_the_map_is_as_good_as_its_voxels(street: Rendered):
    part = street.cut(40, 70)
    oracle = OraclePredictor(part.reference, part.depth)
    exact = ["visual_odometry.enabled=false", "depth.refine=none"]  # true depth is the better one
    result = SlamPipeline(part, oracle, load_config(None, exact)).run()
    points = se3.apply(street.street.T_world_camera[40], result.map.cloud().points)
    assert np.median(street.street.distance_to_surface(points)) < 0.03


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The embedded street through the networks trained on other streets."""
    output = tmp_path_factory.mktemp("learned") / "run"
    run_slam(weights="sim", frames="20:100", output=output, device="cpu")
    return output


def steps(path: Path) -> FloatArray:
    """Motions ``(N - 1, 4, 4)`` from each frame of a KITTI file to the next."""
    T_world_camera = read_trajectory(path).T_world_camera
    return se3.invert(T_world_camera[:-1]) @ T_world_camera[1:]


@pytest.mark.slow
def test_rotations_of_the_shipped_networks_follow_the_road(
    learned: Path, check_run: Callable[[Path], dict[str, Any]]
):
    metrics = check_run(learned)
    assert metrics["provenance"]["leak"] is False
    network, truth = (
        steps(learned / "trajectory_network.kitti.txt"),
        steps(learned / "reference.kitti.txt"),
    )
    right = [np.arctan2(T_step[:, 0, 2], T_step[:, 2, 2]) for T_step in (network, truth)]
    assert np.corrcoef(right)[0, 1] > 0.7
    assert (network[:, 2, 3] > 0).mean() > 0.95  # forward


@pytest.mark.slow
def test_the_system_is_better_than_its_networks(
    learned: Path, check_run: Callable[[Path], dict[str, Any]]
):
    metrics = check_run(learned)
    errors = {
        name: metrics["trajectories"][name]["align"]
        for name in ("network", "odometry", "optimised")
    }
    assert errors["network"]["7dof"]["ate_rmse_m"] < 2 * 0.738
    assert errors["odometry"]["7dof"]["ate_rmse_m"] < 2 * 0.117
    assert errors["optimised"]["7dof"]["ate_rmse_m"] < 2 * 0.108
    assert errors["optimised"]["6dof"]["ate_rmse_m"] < 2 * 0.367
    assert metrics["scale"]["mode"] == "camera-height"
    assert (metrics["map"]["triangles"] or 0) > 1000 and metrics["map"][
        "accuracy_median_m"
    ] < 2 * 0.153


@pytest.mark.slow
def test_the_map_of_a_simulated_root_on_disk_has_an_error(
    tmp_path: Path, check_run: Callable[[Path], dict[str, Any]]
):
    street = SimulatedSequence(SimulationOptions("straight", frames=40, seed=703)).street
    write_kitti_root(street, tmp_path / "root", depth=True)
    run = run_slam(tmp_path / "root", weights="sim", output=tmp_path / "run", device="cpu")
    found = check_run(run.path)["map"]
    assert found["truth"] == "depth maps"
    assert 0.02 < found["accuracy_median_m"] < 0.5 and found["completeness"] > 0.4
    assert 0.3 < found["f_score"]["0.2"] < found["f_score"]["0.5"] < 1.0
