"""Error of a map against a known surface, by hand values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from slam.evaluation.map import (
    Indices,
    Mask,
    PlacedMetrics,
    Surface,
    accumulated,
    backprojected,
    compare,
    double_wall_share,
    placed_errors,
    pose_similarity,
    stretches,
)
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.geometry.se3 import FloatArray

HEIGHT_M = 1.65
CELL_M = 0.05
CLOSE_M = 1e-5


def road(width_m: float = 6.0, length_m: float = 20.0) -> FloatArray:
    """A grid of points under the cameras, one in each 5 cm voxel."""
    x, z = np.arange(-width_m / 2, width_m / 2, CELL_M), np.arange(0.0, length_m, CELL_M)
    grid = np.stack(np.meshgrid(x, z), axis=-1).reshape(-1, 2) + CELL_M / 2
    return np.column_stack([grid[:, 0], np.full(len(grid), HEIGHT_M), grid[:, 1]])


@dataclass
class Road:
    """A plane that every camera sees whole."""

    points: FloatArray
    frames: Indices
    exact: bool = False
    name: str = "plane"
    views: int = 0

    @property
    def distance(self) -> Callable[[FloatArray], FloatArray] | None:
        return (lambda points: np.abs(points[:, 1] - HEIGHT_M)) if self.exact else None

    def view(self, frame: int) -> Surface:
        self.views += 1
        return Surface(self.points, np.ones(len(self.points), dtype=bool))

    def in_field(self, points: FloatArray, frames: Indices) -> Mask:
        return points[:, 0] > 0


def straight(frames: int = 21, step_m: float = 1.0) -> FloatArray:
    T_world_camera = np.tile(np.eye(4), (frames, 1, 1))
    T_world_camera[:, 2, 3] = step_m * np.arange(frames)
    return T_world_camera


def errors(points: FloatArray, exact: bool = False) -> dict[str, Any]:
    truth = Road(road(), np.arange(21), exact)
    return PlacedMetrics.of(
        **placed_errors(compare(truth, straight(), {"map": points})[0]["map"])
    ).tree()


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize(
    ("offset_m", "covered", "f_scores"), [(0.1, 1, (1, 1)), (0.25, 1, (0, 1)), (0.4, 0, (0, 1))]
)
def test_a_raised_plane_is_wrong_by_its_offset(
    offset_m: float, covered: float, f_scores: tuple[float, float], exact: bool
):
    found = errors(road() - [0.0, offset_m, 0.0], exact)
    assert found["accuracy_median_m"] == pytest.approx(offset_m, abs=CLOSE_M)
    assert found["accuracy_90_m"] == pytest.approx(offset_m, abs=CLOSE_M)
    assert found["completeness"] == covered
    assert (found["f_score"]["0.2"], found["f_score"]["0.5"]) == f_scores
    assert found["outlier_share"] == 0.0


def test_half_a_plane_is_accurate_and_half_complete():
    points = road()
    found = errors(points[points[:, 0] < 0])
    assert found["accuracy_median_m"] == pytest.approx(0.0, abs=CLOSE_M)
    assert found["completeness"] == pytest.approx(0.5 + 0.3 / 6.0, abs=0.02)
    assert found["precision"] == {"0.2": 1.0, "0.5": 1.0}
    recall = 0.5 + 0.5 / 6.0
    assert found["f_score"]["0.5"] == pytest.approx(2 * recall / (1 + recall), abs=0.02)


def test_density_does_not_weigh():
    points = road()
    good, bad = points[points[:, 0] < 0], points[points[:, 0] >= 0] - [0.0, 2.0, 0.0]
    found = errors(np.concatenate([np.repeat(good, 20, axis=0), bad]))
    assert found["outlier_share"] == pytest.approx(0.5, abs=0.03)
    assert found["accuracy_90_m"] == pytest.approx(2.0, abs=CLOSE_M)
    assert found["in_field"]["share"] == pytest.approx(0.5, abs=0.03)
    assert found["in_field"]["accuracy_median_m"] == pytest.approx(2.0, abs=CLOSE_M)


@pytest.mark.slow
def test_the_curve_is_over_the_distance_from_the_nearest_camera():
    points = road(36.0)
    points[np.abs(points[:, 0]) > 9.0, 1] -= 0.35
    truth = Road(road(36.0), np.arange(21))
    found = PlacedMetrics.of(
        **placed_errors(compare(truth, straight(), {"map": points})[0]["map"])
    ).tree()
    near, _, _, far, beyond = found["by_distance"]
    assert (near["from_m"], near["to_m"], beyond["to_m"]) == (0.0, 5.0, 25.0)
    assert (
        near["accuracy_median_m"] == pytest.approx(0.0, abs=CLOSE_M)
        and near["f_score"]["0.2"] == 1.0
    )
    assert (
        far["accuracy_median_m"] == pytest.approx(0.35, abs=CLOSE_M) and far["completeness"] < 0.1
    )
    assert far["f_score"] == {"0.2": 0.0, "0.5": 1.0}
    assert "too few" in beyond["f_score"]["0.2_reason"] and beyond["completeness"] is None


def test_an_empty_map_has_reasons_and_covers_nothing():
    found = errors(np.array([[0.0, 90.0, 0.0]]))
    assert found["completeness"] == 0.0 and found["accuracy_median_m"] is None
    assert (
        "no map point" in found["accuracy_median_m_reason"]
        and "no map point" in found["f_score"]["0.2_reason"]
    )


def test_only_the_road_of_known_surface_counts():
    truth = Road(road(), np.arange(21))
    distances, length_m = compare(
        truth,
        straight(200),
        {"map": np.concatenate([road(), road() + np.array([0.0, 0.0, 100.0])])},
    )
    assert placed_errors(distances["map"])["outlier_share"] == 0.0
    assert length_m == pytest.approx(26.0)


def test_a_long_drive_is_sampled_evenly():
    T_world_camera = straight(5000)
    parts = stretches(T_world_camera, np.arange(5000))
    assert len(parts) == 5 and all(len(part) == 100 for part in parts)
    assert parts[0][0] < 1000 and parts[-1][-1] > 4000
    truth = Road(road(1.0, 1.0), np.arange(5000))
    _, length_m = compare(truth, T_world_camera, {"map": road(1.0)})
    assert length_m == pytest.approx(500.0)
    assert truth.views <= 5 * 201


def test_a_point_in_an_image_takes_the_place_of_one_beside_it():
    class Views(Road):
        def view(self, frame: int) -> Surface:
            return Surface(self.points[frame : frame + 1], np.array([frame == 1]))

    points = np.array([[1.01, 0.02, 3.0], [1.02, 0.02, 3.0], [1.03, 0.02, 3.0], [1.06, 0.02, 3.0]])
    surface = accumulated(Views(points, np.arange(4)), np.arange(4), np.zeros((1, 3)))
    np.testing.assert_allclose(surface.points, points[[1, 3]], atol=CLOSE_M)
    assert surface.in_image.tolist() == [True, False]


def test_depth_becomes_points_in_the_world():
    rays = Intrinsics(21, 11, 50.0, 50.0, 10.0, 5.0).rays(
        Intrinsics(21, 11, 50.0, 50.0, 10.0, 5.0).pixel_grid()
    )
    depth = np.full((11, 21), 8.0)
    depth[:, 0] = 0.0  # nothing there
    depth[:, 20] = 20.0  # a ray longer than 20 m
    T_world_camera = se3.from_rotation_vector(
        np.array([0.0, np.pi / 2, 0.0]), np.array([1.0, 2.0, 3.0])
    )
    points = backprojected(depth, rays, T_world_camera, 20.0)
    assert points.shape == (11 * 19, 3)
    # the camera looks along +x of the world: its own x axis is -z there
    np.testing.assert_allclose(points[:, 0], 9.0)
    assert [9.0, 2.0, 3.0] in points.round(9).tolist()


def drive(frames: int = 40) -> FloatArray:
    step = se3.from_rotation_vector(np.array([0.0, 0.05, 0.0]), np.array([0.0, 0.0, 1.0]))
    return se3.chain(np.tile(step, (frames - 1, 1, 1)))


def test_similarity_undoes_one():
    truth = drive()
    moved = se3.Similarity(
        0.2, se3.from_rotation_vector(np.array([0.3, -1.0, 0.2]), np.zeros(3))[:3, :3], np.ones(3)
    )
    back = pose_similarity(truth, moved.apply_to_poses(truth))
    assert back.scale == pytest.approx(5.0)
    np.testing.assert_allclose(back.apply_to_poses(moved.apply_to_poses(truth)), truth, atol=1e-9)
    rigid = pose_similarity(truth, moved.apply_to_poses(truth), with_scale=False)
    assert rigid.scale == 1.0
    np.testing.assert_allclose(rigid.R_a_b, moved.R_a_b.T, atol=1e-9)


def test_similarity_keeps_the_roll_of_a_straight_road():
    """Positions on a line do not determine it; orientations do."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (50, 1, 1))
    truth[:, 2, 3] = np.arange(50)
    noisy = truth @ se3.from_rotation_vector(
        0.005 * rng.normal(size=(50, 3)), 0.05 * rng.normal(size=(50, 3))
    )
    roll = se3.rotation_angle(pose_similarity(truth, noisy).R_a_b)
    assert roll < np.deg2rad(0.3)


def test_positions_of_a_long_drive_outweigh_a_constant_error_of_its_orientations():
    truth = straight(200)
    tilted = truth.copy()
    tilted[:, :3, :3] = se3.from_rotation_vector(
        np.array([np.deg2rad(1.0), 0.0, 0.0]), np.zeros(3)
    )[:3, :3]
    assert se3.rotation_angle(pose_similarity(truth, tilted, with_scale=False).R_a_b) < np.deg2rad(
        0.1
    )


SQUARE = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], float)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])  # looks along z


@pytest.mark.parametrize(("distance", "share"), [(0.1, 0.0), (1.0, 0.5), (1.9, 0.5), (2.5, 0.0)])
def test_the_surface_behind_another_counts(distance: float, share: float):
    vertices = np.concatenate([SQUARE, SQUARE + np.array([0, 0, distance])])
    assert double_wall_share(
        [(vertices, np.concatenate([TRIANGLES, TRIANGLES + 4]))]
    ) == pytest.approx(share)


def test_the_two_sides_of_a_body_are_not_a_double_wall():
    vertices = np.concatenate([SQUARE, SQUARE - np.array([0, 0, 1.0])])
    back = TRIANGLES[:, ::-1] + 4
    assert double_wall_share([(vertices, np.concatenate([TRIANGLES, back]))]) == 0
    assert np.isnan(double_wall_share([]))
