"""The dense map: learned depth fused into a truncated signed distance field (TSDF).

Curless and Levoy 1996 on Open3D's sparse ``VoxelBlockGrid``. Learned depth is wrong far away, at depth edges and where
two views disagree; these three are filtered out before fusion.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slam.config import MappingConfig
from slam.errors import SlamError
from slam.formats.ply import coloured_ply, write_ply
from slam.frames import DepthMap, Image, Intrinsics
from slam.runtime.imports import import_open3d
from slam.se3 import FloatArray, invert, rotation_angle

_BLOCK_SIDE = 16
_FIRST_BLOCKS = 3000  # 240 MiB, enough for 300 m of street; growing takes Open3D a second
_SEED_STRIDE = 4  # Open3D activates blocks at these pixels only, and raises where none of them has depth
_ATTRIBUTES = ("tsdf", "weight", "color")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MapMesh:
    """Vertices ``(V, 3)`` in the world, triangles ``(T, 3)`` of them, colours ``(V, 3)`` in [0, 1]."""

    vertices_world: FloatArray
    triangles: NDArray[np.int64]
    colours: FloatArray


@dataclass(frozen=True)
class MapCloud:
    """Points ``(P, 3)`` and unit normals ``(P, 3)`` in the world, colours ``(P, 3)`` in [0, 1]."""

    points_world: FloatArray
    normals_world: FloatArray
    colours: FloatArray


@dataclass(frozen=True)
class MapStatistics:
    """Size of a map, and numbers of frames fused and left out of a full map."""

    triangles: int
    points: int
    blocks: int
    frames_fused: int
    frames_left_out: int


class TsdfMap:
    """TSDF fusion of depth maps along a trajectory; lengths are in the trajectory's unit."""

    def __init__(self, config: MappingConfig, intrinsics: Intrinsics) -> None:
        self._config = config
        self._size = (intrinsics.height, intrinsics.width)
        self._intrinsics = intrinsics
        self._rays = _rays(intrinsics)
        self._grid = self._new_grid()
        self._previous: _View | None = None
        self._first_is_fused = False
        self._fused = 0
        self._left_out = 0
        self._mesh: MapMesh | None = None
        self._cloud: MapCloud | None = None

    def integrate(self, depth: DepthMap, image: Image, T_world_camera: FloatArray) -> None:
        """Filter a depth map by the previous keyframe and fuse it; skip it if the camera hardly moved.

        Args:
            depth: metric z-depth ``(H, W)`` at the size of the intrinsics, not positive where unknown.
            image: its image ``(H, W, 3)`` uint8 RGB.
            T_world_camera: its pose.
        """
        if depth.shape != self._size or image.shape != (*self._size, 3):
            raise ValueError(f"depth and image must be {self._size}; got {depth.shape} and {image.shape}")
        view = self._view(depth, image, T_world_camera)
        previous = self._previous
        if previous is None:
            self._previous = view
        elif self._has_moved(view.T_world_camera, previous.T_world_camera):
            if not self._first_is_fused:
                self._fuse(previous, self._agrees(previous, view))
                self._first_is_fused = True
            self._fuse(view, self._agrees(view, previous))
            self._previous = view

    def moved(self, frames: Sequence[int], T_world_camera: FloatArray) -> list[int]:
        """Which of these frames ``integrate`` does not skip, as positions in ``frames``.

        Args:
            frames: frame numbers in time order.
            T_world_camera: poses of all frames ``(N, 4, 4)``.
        """
        found: list[int] = []
        for position, frame in enumerate(frames):
            if not found or self._has_moved(T_world_camera[frame], T_world_camera[frames[found[-1]]]):
                found.append(position)
        return found

    def mesh(self) -> MapMesh:
        """The surface as triangles, small loose pieces removed.

        Raises:
            SlamError: if nothing was fused or seen often enough.
        """
        if self._mesh is None:
            self._fuse_single_keyframe()
            extracted = self._extract(self._grid.extract_triangle_mesh)
            mesh = MapMesh(
                _array(extracted.vertex.positions),
                extracted.triangle.indices.numpy().astype(np.int64),
                _array(extracted.vertex.colors),
            )
            self._mesh = _without_small_components(_sorted(mesh), self._config.min_component_triangles)
        if len(self._mesh.triangles) == 0:
            raise SlamError("the map is empty: no piece of surface is larger than min_component_triangles")
        return self._mesh

    def cloud(self) -> MapCloud:
        """The surface as points; ``SlamError`` as for the mesh."""
        if self._cloud is None:
            self._fuse_single_keyframe()
            point = self._extract(self._grid.extract_point_cloud).point
            # sorted, for the order of Open3D's threads is not reproducible
            order = np.lexsort(_array(point.positions).T)
            positions, normals, colours = (
                _array(part)[order] for part in (point.positions, point.normals, point.colors)
            )
            self._cloud = MapCloud(positions, normals, colours)
        return self._cloud

    def statistics(self) -> MapStatistics:
        """Counts, zero for an empty map."""
        try:
            triangles, points = len(self.mesh().triangles), len(self.cloud().points_world)
        except SlamError:
            triangles = points = 0
        blocks = int(self._grid.hashmap().size())
        return MapStatistics(triangles, points, blocks, self._fused, self._left_out)

    def write_mesh(self, path: Path) -> None:
        """Write the mesh as binary PLY, atomically.

        Raises:
            SlamError: the map is empty, or (`RunError`) the file cannot be written.
        """
        mesh = self.mesh()
        write_ply(path, coloured_ply(mesh.vertices_world, _vertex_normals(mesh), mesh.colours, mesh.triangles))

    def write_cloud(self, path: Path) -> None:
        """Write the cloud as binary PLY, atomically; raises as ``write_mesh``."""
        cloud = self.cloud()
        write_ply(path, coloured_ply(cloud.points_world, cloud.normals_world, cloud.colours))

    def _new_grid(self) -> Any:
        o3d = import_open3d()
        kind = o3d.core.float32
        return o3d.t.geometry.VoxelBlockGrid(
            _ATTRIBUTES,
            (kind, kind, kind),
            ((1), (1), (3)),
            self._config.voxel_size_m,
            _BLOCK_SIDE,
            min(_FIRST_BLOCKS, self._config.max_blocks),
            o3d.core.Device("CPU:0"),
        )

    def _view(self, depth: DepthMap, image: Image, T_world_camera: FloatArray) -> _View:
        known = np.isfinite(depth) & (depth > 0)
        return _View(np.where(known, depth, np.float32(0)).astype(np.float32), image, T_world_camera)

    def _has_moved(self, T_world_camera: FloatArray, T_world_previous: FloatArray) -> bool:
        T_previous_camera = invert(T_world_previous) @ T_world_camera
        moved = float(np.linalg.norm(T_previous_camera[:3, 3]))
        turned = float(rotation_angle(T_previous_camera[:3, :3]))
        config = self._config
        return moved >= config.keyframe_distance_m or turned >= np.deg2rad(config.keyframe_rotation_deg)

    def _agrees(self, view: _View, other: _View) -> NDArray[np.bool_]:
        """Pixels ``(H, W)`` whose depth is consistent with the other view's depth."""
        camera = self._intrinsics
        T_other_camera = (invert(other.T_world_camera) @ view.T_world_camera).astype(np.float32)
        points = self._rays * view.depth.ravel()  # (3, H*W)
        x, y, z = T_other_camera[:3, :3] @ points + T_other_camera[:3, 3:]
        before = np.where(z > 1e-3, z, np.float32(np.inf))
        u = np.rint(np.float32(camera.fx) * (x / before) + np.float32(camera.cx))
        v = np.rint(np.float32(camera.fy) * (y / before) + np.float32(camera.cy))
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (z > 1e-3)
        pixel = np.where(inside, v * camera.width + u, 0).astype(np.int64)
        agrees = inside & (np.abs(other.depth.ravel()[pixel] - z) < self._config.consistency * z)
        return np.asarray(agrees.reshape(view.depth.shape))

    def _fuse(self, view: _View, agrees: NDArray[np.bool_]) -> None:
        config = self._config
        near = (view.depth >= config.depth_min_m) & (view.depth < config.depth_max_m)
        kept = near & agrees & ~_at_edges(view.depth, config.max_depth_step)
        rows, columns = (side // _SEED_STRIDE * _SEED_STRIDE for side in kept.shape)
        if not kept[:rows:_SEED_STRIDE, :columns:_SEED_STRIDE].any():
            return
        if self._grid.hashmap().size() >= config.max_blocks:
            if self._left_out == 0:
                logger.warning("the map is full (%d blocks): later frames are left out", config.max_blocks)
            self._left_out += 1
            return
        self._integrate(np.where(kept, view.depth, np.float32(0)), view.image, view.T_world_camera)
        self._fused += 1
        self._mesh = self._cloud = None

    def _integrate(self, depth: DepthMap, image: Image, T_world_camera: FloatArray) -> None:
        o3d = import_open3d()
        K = self._intrinsics.K
        # Open3D truncates projected pixels where we round them: its pixel centres are at (0.5, 0.5)
        K[:2, 2] += 0.5
        intrinsic = o3d.core.Tensor(K)
        extrinsic = o3d.core.Tensor(invert(T_world_camera))  # Open3D wants T_camera_world
        depth_image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth)))
        colour_image = o3d.t.geometry.Image(o3d.core.Tensor(image.astype(np.float32) / np.float32(255)))
        depth_scale, truncation = 1.0, self._config.truncation_voxels
        depth_max = self._config.depth_max_m
        blocks = self._grid.compute_unique_block_coordinates(
            depth_image, intrinsic, extrinsic, depth_scale, depth_max, truncation
        )
        self._grid.integrate(
            blocks, depth_image, colour_image, intrinsic, extrinsic, depth_scale, depth_max, truncation
        )

    def _fuse_single_keyframe(self) -> None:
        """Fuse the only keyframe without a check: there is no second view to compare it with."""
        if self._previous is not None and not self._first_is_fused:
            self._fuse(self._previous, np.ones(self._previous.depth.shape, dtype=bool))
            self._first_is_fused = True

    def _extract(self, extract: Callable[[float], Any]) -> Any:
        if self._fused == 0:
            raise SlamError("the map is empty: no depth passed the filters")
        # a frame weighs 1: with fewer frames than min_weight nothing would be extracted
        weight = min(self._config.min_weight, self._fused) - 0.5
        unseen = SlamError(f"the map is empty: no surface was seen {self._config.min_weight:g} times")
        try:
            extracted = extract(weight)
        except RuntimeError as error:  # Open3D cannot build an empty geometry
            raise unseen from error
        if extracted.is_empty():
            raise unseen
        return extracted


@dataclass(frozen=True)
class _View:
    """A frame: depth ``(H, W)`` with 0 where unknown, its image and pose."""

    depth: DepthMap
    image: Image
    T_world_camera: FloatArray


def _rays(intrinsics: Intrinsics) -> NDArray[np.float32]:
    """Rays ``(3, H*W)`` with z = 1."""
    rays = intrinsics.rays(intrinsics.pixel_grid()).reshape(-1, 3)
    return np.ascontiguousarray(rays.T, dtype=np.float32)


def _at_edges(depth: DepthMap, max_step: float) -> NDArray[np.bool_]:
    """Pixels on either side of a relative depth step, where networks blur depth."""
    edges = np.zeros(depth.shape, dtype=bool)
    for near, far in (
        ((slice(None), slice(1, None)), (slice(None), slice(-1))),
        ((slice(1, None),), (slice(-1),)),
    ):
        a, b = depth[near], depth[far]
        step = np.abs(a - b) > max_step * np.minimum(a, b)
        edges[near] |= step
        edges[far] |= step
    return edges


def _sorted(mesh: MapMesh) -> MapMesh:
    """The same mesh in an order that does not depend on Open3D's threads."""
    order = np.lexsort(mesh.vertices_world.T)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    triangles = rank[mesh.triangles]
    first = triangles.argmin(axis=1)[:, None]  # cyclic rotation keeps the orientation of a triangle
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    return MapMesh(mesh.vertices_world[order], triangles, mesh.colours[order])


def _without_small_components(mesh: MapMesh, min_triangles: int) -> MapMesh:
    count, triangles = len(mesh.vertices_world), mesh.triangles
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array((np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, component = connected_components(links, directed=False)
    sizes = np.bincount(component[triangles[:, 0]], minlength=1)
    kept = triangles[sizes[component[triangles[:, 0]]] >= min_triangles]
    used, renumbered = np.unique(kept, return_inverse=True)
    return MapMesh(mesh.vertices_world[used], renumbered.reshape(-1, 3), mesh.colours[used])


def _vertex_normals(mesh: MapMesh) -> FloatArray:
    """Unit normals ``(V, 3)``: means of the triangles around each vertex, by their area."""
    o3d = import_open3d()
    vertices, triangles = o3d.utility.Vector3dVector(mesh.vertices_world), o3d.utility.Vector3iVector(mesh.triangles)
    return np.asarray(o3d.geometry.TriangleMesh(vertices, triangles).compute_vertex_normals().vertex_normals)


def _array(tensor: Any) -> FloatArray:
    return np.asarray(tensor.numpy(), dtype=np.float64)
