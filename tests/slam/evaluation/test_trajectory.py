"""The object T: exact values under known motions, golden values, degenerate input, limits, evo; drift by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.core.metrics import RPE, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from erfsfm.evaluation.pose_metrics import SnippetErrors
from slam.evaluation.trajectory import (
    ALIGNMENTS,
    FIGURE_LENGTHS_M,
    AlignedMetrics,
    aligned,
    exceeded,
    segment_errors,
    trajectory_metrics,
)
from slam.formats.trajectory import Trajectory, read_trajectory
from slam.geometry import se3
from slam.geometry.se3 import FloatArray, Similarity, from_rotation_vector
from slam.results.folder import RunFolder


def moved(trajectory: Trajectory, scale: float) -> Trajectory:
    """The same motion in another world and unit."""
    T_other_world = from_rotation_vector(np.array([0.3, -0.5, 0.2]), np.array([4.0, 5.0, 6.0]))
    similarity = Similarity(scale, T_other_world[:3, :3], T_other_world[:3, 3])
    return Trajectory(trajectory.stamps, similarity.apply_to_poses(trajectory.T_world_camera))


def test_alignment_removes_a_similarity_and_drift_is_then_zero(make_run: Callable[..., RunFolder]):
    reference = make_run().trajectory("reference")
    fitted = aligned({"reference": reference, "optimised": moved(reference, 0.2)})["optimised"]
    np.testing.assert_allclose(fitted.positions, reference.positions, atol=1e-5)
    segments = segment_errors(fitted.T_world_camera, reference.T_world_camera, FIGURE_LENGTHS_M)
    assert [length_m for length_m, _, _ in segments] == [10.0, 20.0, 50.0, 100.0, 200.0]
    assert max(errors.max() for _, *both in segments for errors in both) < 1e-4


def test_drift_of_a_known_scale_and_rotation_has_its_hand_value():
    ((_, translation_m, rotation),) = segment_errors(line(121, 1.05), line(121), [10.0])
    # a segment ends with the first frame beyond its length, KITTI's rule: 11 m for 10 m
    assert translation_m == pytest.approx(0.05 * 11)
    assert (rotation == 0.0).all()


A_KEYS = set(AlignedMetrics.names())
SHAPE = {
    "snippet5": {"ate_mean", "ate_std", "re_mean", "re_std", "count"},
    "evo": {"ape_rmse_m_7dof", "rpe_trans_m", "rpe_rot_deg", "difference"},
}


def trajectory(T_world_camera: FloatArray) -> Trajectory:
    return Trajectory(0.1 * np.arange(len(T_world_camera), dtype=np.float64), T_world_camera)


def drive(frames: int = 400, step_m: float = 1.0) -> FloatArray:
    """A winding, hilly drive ``(N, 4, 4)`` from the identity."""
    k = np.arange(frames - 1)
    turns = np.stack(
        [0.01 * np.sin(0.07 * k), 0.03 * np.cos(0.02 * k), 0.002 * np.sin(0.11 * k)], axis=1
    )
    return se3.chain(se3.from_rotation_vector(turns, np.tile([0.0, 0.0, step_m], (frames - 1, 1))))


def line(frames: int, step_m: float = 1.0) -> FloatArray:
    T_world_camera = np.tile(np.eye(4), (frames, 1, 1))
    T_world_camera[:, 2, 3] = step_m * np.arange(frames)
    return T_world_camera


def check_shape(metrics: dict[str, Any]) -> None:
    """Every number is there, or None with a reason; the whole is JSON without NaN."""
    json.dumps(metrics, allow_nan=False)
    assert set(metrics) == {"snippet5", "align", "evo"}
    assert tuple(metrics["align"]) == ALIGNMENTS
    records = [(metrics[name], keys) for name, keys in SHAPE.items()]
    for record, keys in records + [(record, A_KEYS) for record in metrics["align"].values()]:
        assert {key for key in record if not key.endswith("_reason")} >= keys
        for key in keys:
            assert (record[key] is None) == bool(record.get(f"{key}_reason"))


def ate(metrics: dict[str, Any]) -> dict[str, float | None]:
    return {name: record["ate_rmse_m"] for name, record in metrics["align"].items()}


def metrics_of(*given: Any, **named: Any) -> dict[str, Any]:
    """T as ``metrics.json`` has it."""
    return trajectory_metrics(*given, **named).tree()


def test_a_known_similarity_under_each_alignment():
    """The estimate is the truth, 2.5 times too small, from a world that is rotated and moved."""
    truth = drive()
    turn, move = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([5.0, -6.0, 7.0])
    estimate = se3.Similarity(1 / 2.5, turn, move).apply_to_poses(truth)
    metrics = metrics_of(trajectory(estimate), trajectory(truth))
    check_shape(metrics)
    positions = truth[:, :3, 3]
    as_written = np.linalg.norm(estimate[:, :3, 3] - positions, axis=1)
    spread = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    expected = {
        "none": math.sqrt((as_written**2).mean()),
        "first": 0.6 * math.sqrt((positions**2).sum(axis=1).mean()),
        "scale": 0.0,
        "6dof": 0.6 * math.sqrt((spread**2).mean()),
        "7dof": 0.0,
    }
    assert ate(metrics) == pytest.approx(expected, abs=1e-10)
    for name, record in metrics["align"].items():
        scaled = name in ("scale", "7dof")
        assert record["scale"] == pytest.approx(2.5 if scaled else 1.0, rel=1e-12)
        assert record["rpe_trans_m"] == pytest.approx(0.0 if scaled else 0.6, abs=1e-10)
        assert record["rpe_rot_deg"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["snippet5"]["ate_mean"] == pytest.approx(0.0, abs=1e-12)
    assert metrics["evo"]["difference"] < 1e-6


def test_a_noisy_estimate_agrees_with_evo():
    rng = np.random.default_rng(7)
    noise = se3.from_rotation_vector(
        rng.normal(scale=0.02, size=(400, 3)), rng.normal(scale=0.5, size=(400, 3))
    )
    metrics = metrics_of(trajectory(drive() @ noise), trajectory(drive()))
    assert 0.5 < metrics["evo"]["ape_rmse_m_7dof"] < 1.0
    assert metrics["evo"]["ape_rmse_m_7dof"] == pytest.approx(
        metrics["align"]["7dof"]["ate_rmse_m"], abs=1e-9
    )
    assert metrics["evo"]["difference"] < 1e-6
    paths = [PosePath3D(poses_se3=[*T]) for T in (drive(), drive() @ noise)]
    paths[1].align(paths[0])
    rpe = RPE(PoseRelation.translation_part, 1, Unit.frames)
    rpe.process_data(tuple(paths))
    rmse = rpe.get_statistic(StatisticsType.rmse)
    assert metrics["align"]["6dof"]["rpe_trans_rmse_m"] == pytest.approx(rmse, rel=1e-9)


def test_hand_values_of_segments_and_steps():
    """A straight line whose estimate is 2 % long and turns 0.001 rad a metre about its own axis of motion."""
    truth, estimate = line(251), line(251, 1.02)
    estimate[:, :3, :3] = Rotation.from_rotvec(
        np.outer(0.001 * np.arange(251), [0.0, 0.0, 1.0])
    ).as_matrix()
    record = metrics_of(trajectory(estimate), trajectory(truth))["align"]["first"]
    # A segment of L m ends at the first frame beyond: L + 1 steps. Starts 0 to 140 hold 100 m, 0 to 40 200 m.
    share = (15 * 101 / 100 + 5 * 201 / 200) / 20
    assert record["t_rel_percent"] == pytest.approx(2.0 * share, rel=1e-9)
    assert record["r_rel_deg_per_100m"] == pytest.approx(np.rad2deg(0.1) * share, rel=1e-9)
    assert record["rpe_trans_m"] == pytest.approx(0.02, rel=1e-9)
    assert record["rpe_rot_deg"] == pytest.approx(np.rad2deg(0.001), rel=1e-9)


@pytest.mark.parametrize(("frames", "fits"), [(100, False), (101, False), (103, True)])
def test_short_paths_have_no_segments(frames: int, fits: bool):
    record = metrics_of(trajectory(line(frames)), trajectory(line(frames)))["align"]["none"]
    assert (record["t_rel_percent"] is not None) == fits
    if not fits:
        assert (
            record["t_rel_percent_reason"]
            == f"no segment of 100 m fits into the path of {frames - 1}.0 m"
        )
        assert record["r_rel_deg_per_100m"] is None


def test_without_a_reference_every_number_has_a_reason():
    metrics = metrics_of(trajectory(drive(10)), None)
    check_shape(metrics)
    assert metrics["snippet5"]["count_reason"] == "there is no reference trajectory"
    assert set(ate(metrics).values()) == {None}
    given = metrics_of(trajectory(drive(10)), None, SnippetErrors(0.1, 0.2, 0.3, 0.4, 5))
    assert given["snippet5"] == {
        "ate_mean": 0.1,
        "ate_std": 0.2,
        "re_mean": 0.3,
        "re_std": 0.4,
        "count": 5,
    }


def test_an_estimate_that_stands_still_has_no_scale():
    metrics = metrics_of(trajectory(np.tile(drive(3)[2], (300, 1, 1))), trajectory(drive(300)))
    check_shape(metrics)
    for name in ("scale", "7dof"):
        assert metrics["align"][name]["scale"] is None
        assert metrics["align"][name]["rpe_trans_m"] == pytest.approx(1.0)
        assert metrics["align"][name]["t_rel_percent"] > 50
    assert metrics["snippet5"]["ate_mean"] == pytest.approx(math.sqrt(1 + 4 + 9 + 16) / 5, rel=0.01)
    assert "evo fails" in metrics["evo"]["difference_reason"]


def test_a_reference_that_stands_still_cannot_be_scaled_to():
    metrics = metrics_of(trajectory(drive(20)), trajectory(np.tile(np.eye(4), (20, 1, 1))))
    check_shape(metrics)
    errors = ate(metrics)
    assert errors["scale"] is None
    assert errors["7dof"] is None
    assert (errors["first"] or 0.0) > 1.0
    assert metrics["align"]["first"]["rpe_trans_m"] == pytest.approx(1.0)
    snippets = metrics["snippet5"]
    assert snippets["ate_mean"] is None and snippets["ate_std"] is None
    assert "the reference does not move" in snippets["ate_mean_reason"]
    assert snippets["re_mean"] > 0 and snippets["count"] == 16  # rotations have no scale
    direct = metrics_of(
        trajectory(drive(20)),
        trajectory(np.tile(np.eye(4), (20, 1, 1))),
        SnippetErrors(0.0, 0.0, 0.3, 0.4, 5),
    )
    assert direct["snippet5"]["ate_mean"] is None and direct["snippet5"]["re_mean"] == 0.3


def test_a_camera_that_turns_on_the_spot_has_errors_of_rotation():
    turning = np.tile(np.eye(4), (20, 1, 1))
    turning[:, :3, :3] = Rotation.from_rotvec(
        np.outer(np.deg2rad(np.arange(20)), [0, 1, 0])
    ).as_matrix()
    metrics = metrics_of(trajectory(np.tile(np.eye(4), (20, 1, 1))), trajectory(turning))
    assert metrics["align"]["first"]["rpe_rot_deg"] == pytest.approx(1.0)


@pytest.mark.parametrize("unturned", ["reference", "estimate"])
def test_without_rotations_only_positions_are_compared(unturned: str):
    pair = {"reference": drive(), "estimate": drive()}
    pair[unturned][:, :3, :3] = np.eye(3)
    metrics = metrics_of(trajectory(pair["estimate"]), trajectory(pair["reference"]))
    check_shape(metrics)
    whole = metrics["align"]["6dof"]
    assert whole["ate_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    for key in ("t_rel_percent", "r_rel_deg_per_100m", "rpe_trans_m", "rpe_rot_deg"):
        assert whole[key] is None and f"the {unturned} has no rotations" in whole[f"{key}_reason"]
    assert metrics["align"]["first"]["ate_rmse_m"] is None
    assert metrics["snippet5"]["re_mean"] is None


def test_a_straight_line_is_measured_though_evo_fails():
    metrics = metrics_of(trajectory(line(120, 0.5)), trajectory(line(120)))
    check_shape(metrics)
    assert metrics["align"]["7dof"]["scale"] == pytest.approx(2.0)
    assert metrics["align"]["7dof"]["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["align"]["7dof"]["t_rel_percent"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["evo"]["ape_rmse_m_7dof"] is None


@pytest.mark.parametrize(("frames", "known"), [(1, set()), (2, {"none", "first"})])
def test_one_and_two_frames(frames: int, known: set[str]):
    metrics = metrics_of(trajectory(line(frames)), trajectory(line(frames, 2.0)))
    check_shape(metrics)
    assert {name for name, value in ate(metrics).items() if value is not None} == known
    assert metrics["snippet5"]["count"] == 0
    assert metrics["snippet5"]["ate_mean_reason"] == "a snippet needs 5 frames"


@pytest.mark.parametrize(
    ("estimate", "truth", "alignment", "reason"),
    [
        (line(20, 0.0), line(20, 0.0), "none", "neither the estimate nor the reference moves"),
        (line(20, -1.0), line(20), "scale", "the other way"),
        (
            np.where(np.arange(20)[:, None, None] == 11, np.nan, line(20)),
            line(20),
            "none",
            "not finite",
        ),
    ],
)
def test_what_has_no_error_has_a_reason(
    estimate: FloatArray, truth: FloatArray, alignment: str, reason: str
):
    metrics = metrics_of(trajectory(estimate), trajectory(truth))
    check_shape(metrics)
    assert reason in metrics["align"][alignment]["ate_rmse_m_reason"]


def test_limits():
    rough = drive(60)
    rough[::2, 1, 3] += 0.2
    metrics = trajectory_metrics(trajectory(rough), trajectory(drive(60)))
    assert (
        exceeded(
            metrics,
            [
                "ate_rmse_m=1",
                "align.none.ate_rmse_m = 0.5",
                "snippet5.ate_mean=1",
                "evo.difference=1e-6",
            ],
        )
        == []
    )
    lines = exceeded(metrics, ["ate_rmse_m=0.01", "align.first.rpe_rot_deg=1", "t_rel_percent=5"])
    assert len(lines) == 2
    assert lines[0].startswith("align.7dof.ate_rmse_m is 0.09")
    assert lines[0].endswith("over the limit 0.01")
    assert lines[1].startswith("align.7dof.t_rel_percent is not known (no segment of 100 m")


PUBLISHED = ("ate_rmse_m", "t_rel_percent", "r_rel_deg_per_100m", "rpe_trans_m", "rpe_rot_deg")


@pytest.mark.data
@pytest.mark.parametrize(
    ("sequence", "six", "seven"),
    [
        ("09", [10.880, 2.607, 0.288, 0.056, 0.037], [10.729, 2.528, 0.288, 0.054, 0.037]),
        ("10", [3.721, 2.293, 0.369, 0.047, 0.043], [3.356, 2.221, 0.369, 0.047, 0.043]),
    ],
)
def test_golden_numbers(data_root: Path, sequence: str, six: list[float], seven: list[float]):
    """DF-VO's stereo-trained trajectories, as kitti-odom-eval scores them, to every printed digit."""
    files = (
        data_root / "golden" / f"{kind}_{sequence}.txt" for kind in ("dfvo_stereo", "reference")
    )
    metrics = metrics_of(*map(read_trajectory, files))
    for alignment, expected in (("6dof", six), ("7dof", seven)):
        found = metrics["align"][alignment]
        assert [round(found[key], 3) for key in PUBLISHED] == expected
    assert metrics["evo"]["difference"] < 1e-6
