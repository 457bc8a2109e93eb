import numpy as np
import pytest

from slam.config.sections import MappingConfig
from slam.formats.ply import read_ply
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.mapping import submap, surface
from slam.mapping.depth import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_open3d

CAMERA = Intrinsics(208, 64, 120.0, 120.0, 103.5, 31.5)
V, U = np.mgrid[: CAMERA.height, : CAMERA.width]
X, Y = (U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy
GREY = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)


def pose(*position: float, yaw: float = 0.0) -> np.ndarray:
    return se3.from_rotation_vector(np.array([0.0, yaw, 0.0]), np.array(position))


def plate(distance: float) -> np.ndarray:
    """A plate across the axis, 4 m wide and 2 m high, nothing behind it."""
    inside = (np.abs(X * distance) < 2) & (np.abs(Y * distance) < 1)
    return np.where(inside, distance, 0.0).astype(np.float32)


def street(position: np.ndarray) -> np.ndarray:
    """A road 1.65 m below y = 0 between walls at x = -6 and x = 6."""
    with np.errstate(divide="ignore"):
        road = np.where(Y > 0, (1.65 - position[1]) / Y, np.inf)
        left, right = (
            np.where(X < 0, (-6 - position[0]) / X, np.inf),
            np.where(X > 0, (6 - position[0]) / X, np.inf),
        )
    return np.minimum(np.minimum(np.minimum(road, left), right), 90.0).astype(np.float32)


def distance_to_street(points: np.ndarray) -> np.ndarray:
    return np.minimum(np.abs(points[:, 1] - 1.65), np.abs(np.abs(points[:, 0]) - 6))


def street_map(noise=lambda depth, k: depth, frames: int = 12, **config) -> TsdfMap:
    tsdf_map = TsdfMap(MappingConfig(**config), CAMERA)
    for k in range(frames):
        T_world_camera = pose(0.0, 0.0, float(k))
        tsdf_map.integrate(
            KeyframeDepth(0, noise(street(T_world_camera[:3, 3]), k), None, GREY, T_world_camera)
        )
    return tsdf_map


def test_keyframes_that_are_uncertain_everywhere_are_left_out_and_hide_no_neighbour():
    def driven(certain: range) -> TsdfMap:
        tsdf_map = TsdfMap(MappingConfig(), CAMERA)
        for k in range(9):
            T_world_camera, is_certain = pose(0.0, 0.0, float(k)), k in certain
            depth = street(T_world_camera[:3, 3]) * np.float32(1.0 if is_certain else 1.4)
            sigma = np.full_like(depth, 0.05 if is_certain else 0.32)
            tsdf_map.integrate(KeyframeDepth(k, depth, sigma, GREY, T_world_camera))
        return tsdf_map

    tsdf_map = driven(range(0, 9, 2))
    statistics = tsdf_map.statistics()
    assert (statistics["frames_fused"], statistics["frames_left_out"]) == (5, 4)
    assert statistics["filters"]["agreement"] < 0.2
    assert np.quantile(distance_to_street(tsdf_map.cloud().points), 0.99) < 0.1
    nothing = driven(range(0))
    assert nothing.statistics()["frames_left_out"] == 9
    with pytest.raises(SlamError, match=r"none of 9 keyframes .* at most 0.3"):
        nothing.surface()


def test_one_wall_lands_where_the_camera_saw_it():
    # Open3D wants T_camera_world: with the inverse the plate would lie at x = -1
    tsdf_map = TsdfMap(MappingConfig(), CAMERA)
    for z in (0.0, 0.5, 1.0):
        tsdf_map.integrate(KeyframeDepth(0, plate(8.0 - z), None, GREY, pose(1.0, 0.5, z)))
    vertices = tsdf_map.cloud().points
    np.testing.assert_allclose(vertices[:, 2], 8.0, atol=0.003)
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    np.testing.assert_allclose(centre, [1.0, 0.5, 8.0], atol=0.11)
    np.testing.assert_allclose(tsdf_map.cloud().colours, 128, atol=3)


def test_depth_inconsistent_between_views_is_left_out():
    def ghost(depth, k):
        depth = depth.copy()
        if k == 11:  # a body that hangs before the last camera only
            depth[20:40, 90:120] = 5.0
        return depth

    tsdf_map = street_map(ghost)
    assert distance_to_street(tsdf_map.cloud().points).max() < 0.2
    assert (
        tsdf_map.statistics()["filters"]["agreement"]
        > street_map().statistics()["filters"]["agreement"] + 0.001
    )


def test_flying_pixels_and_far_depth_are_left_out(monkeypatch):
    near_wall = np.where(np.abs(X) < 0.3, 6.0, 14.0).astype(np.float32)
    # a network smears the edge over some pixels
    smeared = np.stack([np.convolve(row, np.ones(5) / 5, mode="same") for row in near_wall]).astype(
        np.float32
    )
    smeared[:, :3], smeared[:, -3:] = 14.0, 14.0
    smeared[:8] = 60.0  # sky

    def fuse(largest_ratio):
        monkeypatch.setattr("slam.mapping.depth._MAX_DEPTH_RATIO", largest_ratio)
        monkeypatch.setattr("slam.mapping.depth._MAX_DEPTH_DIFFERENCE", 10.0)
        monkeypatch.setattr(surface, "_LEAST_TRIANGLES", 0)
        monkeypatch.setattr(submap, "TRUNCATION_VOXELS", 4.5)
        tsdf_map = TsdfMap(MappingConfig(), CAMERA)
        for x in (0.0, 0.31):
            tsdf_map.integrate(KeyframeDepth(0, smeared, None, GREY, pose(x, 0.0, 0.0)))
        return tsdf_map.cloud().points

    def between(vertices):
        return ((vertices[:, 2] > 7.5) & (vertices[:, 2] < 12.5)).sum()

    assert between(fuse(largest_ratio=11.0)) > 100
    assert between(fuse(largest_ratio=1.12)) == 0
    assert fuse(largest_ratio=1.12)[:, 2].max() < 26


def test_files_are_written_whole_and_read_back(tmp_path):
    tsdf_map = street_map()
    tsdf_map.surface().write_mesh(tmp_path / "mesh.ply")
    tsdf_map.surface().write_cloud(tmp_path / "cloud.ply")
    o3d = import_open3d()
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    cloud = o3d.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    statistics = tsdf_map.statistics()
    assert len(mesh.triangles) == statistics["triangles"] > 1000
    assert len(cloud.points) == statistics["points"] > 1000
    assert statistics["blocks"] > 0
    assert statistics["frames_fused"] == 12
    assert mesh.has_vertex_colors() and mesh.has_vertex_normals()
    assert cloud.has_normals()
    vertices, triangles = (
        np.concatenate(list(pieces))
        for pieces in (tsdf_map.surface().vertex_pieces(), tsdf_map.surface().triangle_pieces())
    )
    np.testing.assert_array_equal(np.asarray(mesh.triangles), triangles)
    np.testing.assert_array_equal(read_ply(tmp_path / "mesh.ply").vertices, vertices)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cloud.ply", "mesh.ply"]


def test_a_map_goes_on_after_its_surface_was_asked_for():
    whole, asked = (TsdfMap(MappingConfig(), CAMERA) for _ in range(2))
    for k in range(4):
        for tsdf_map in (whole, asked):
            position = pose(0.0, 0.0, float(k))
            tsdf_map.integrate(KeyframeDepth(k, street(position[:3, 3]), None, GREY, position))
        counts = asked.statistics()
        assert counts["frames_fused"] == k + 1 and sum(counts["filters"].values()) > 0
        assert counts["triangles"] == asked.surface().triangles > 0
    assert asked.cloud().points[:, 2].max() > whole.cloud().points[:, 2].max() - 0.5


def test_a_car_that_comes_towards_the_camera_is_not_fused(monkeypatch):
    """A plate 2 m across in front of the left wall, which comes as fast as the camera drives."""

    def oncoming(depth: np.ndarray, k: int) -> np.ndarray:
        distance = np.float32(24.0 - 2.0 * k)  # of the plate, in the camera
        if distance <= 2.0:
            return depth
        on_plate = (np.abs(X * distance + 4.0) < 1) & (np.abs(Y * distance - 0.6) < 1)
        return np.where(on_plate, np.minimum(depth, distance), depth)

    def ghosts(tsdf_map: TsdfMap) -> int:
        x, y, z = tsdf_map.cloud().points.T
        return int(((np.abs(x + 4.0) < 0.9) & (y < 1.2) & (z < 24.0)).sum())

    monkeypatch.setattr("slam.mapping.depth._MAX_DEPTH_DIFFERENCE", 0.3)
    monkeypatch.setattr(surface, "_LEAST_TRIANGLES", 0)
    street_alone, with_car = street_map(frames=12), street_map(oncoming, frames=12)
    assert (
        with_car.statistics()["filters"]["moving"]
        > 0.001
        > street_alone.statistics()["filters"]["moving"]
    )
    assert ghosts(with_car) < 50
