"""Error of a map against the true surface: accuracy, completeness and F-score.

Distances are to the nearest point. Map points within 25 m of a camera count, one per 0.2 m voxel, so that density does
not weigh; so do points of the true surface that the images show. Map where no true surface was measured counts as an
error.

The true surface is of measured points accumulated at true poses, one stretch of road at a time. A long drive is
sampled: a number of stretches, evenly spread, with all that cameras on them see. Time and memory have a bound, whatever
the length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from slam.formats.ply import scene_of
from slam.frames import Mask
from slam.geometry.robust import median
from slam.geometry.se3 import (
    FloatArray,
    IntArray,
    Similarity,
    apply,
    length_of,
    nearest_rotation,
    path_distance,
)
from slam.mapping.submap import moved_rows
from slam.runtime.errors import Failed
from slam.runtime.imports import import_open3d
from slam.runtime.record import Count, Record, part

Indices = NDArray[np.int64]

RANGE_M = 25.0  # of map points and of the true surface to the nearest camera
STRETCH_M = 100.0
MOST_STRETCHES = 5
TRUTH_VOXEL_M = 0.05
_BEYOND_M = 5.0  # of the range of map points: a wrong one may be nearest to surface out there
_WAITING_POINTS = 2_000_000
_NEAR_TRUTH_M = 5.0  # of a camera to the nearest one that measured the surface
_KEY_BITS = 21  # a coordinate in voxels, both signs
NEAR_CAMERA_M = 20.0
COVERED_WITHIN_M = 0.3
F_SCORES_M = {"0.2": 0.2, "0.5": 0.5}
BINS_M = ((0.0, 5.0), (5.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 25.0))
OUTLIER_M = 1.0
# sparse where views do not measure the accuracy
VIEW_STEP_M, SPARSE_VIEW_STEP_M, VIEW_STEP_DEG = (1.0, 3.0, 5.0)
SAMPLE_VOXEL_M = 0.2

_WALL_NEAR_M, _WALL_FAR_M = 0.3, 2.0  # of the second surface in front of the first
_PARALLEL = 0.7  # least cosine of the two normals
_MOST_RAYS = 20_000  # of a piece
_LEVER_M = 10.0  # distance from the camera at which an alignment counts rotations
_LEAST_IN_BIN = 20
_LEAF_POINTS = 32  # of the tree of true surface: less memory than with 16
_NO_MAP = Failed("no map point lies within 25 m of a camera whose surroundings are known")
_NO_SURFACE = Failed("no true surface is known at this distance from a camera")
_FEW = Failed("too few points at this distance from a camera")
# the values of every `PlacedMetrics`
ERRORS = (
    "accuracy_median_m",
    "accuracy_90_m",
    "outlier_share",
    "completeness",
    "f_score",
    "precision",
    "recall",
    "in_field",
    "by_distance",
)


@dataclass(frozen=True)
class Surface:
    """Points ``(P, 3)`` of the true surface in the world, and whether an image shows them within 25 m ``(P,)``."""

    points: FloatArray
    in_image: Mask


@dataclass(frozen=True)
class SurfaceTruth:
    """A source of the true surface; its world is that of the true poses.

    ``name`` says what it is, ``frames`` ``(F,)`` which frames measured the surface, ``view`` gives the surface as one
    of them measured it. ``in_field`` says whether the sensor could have measured points ``(P, 3)`` from any of some
    frames that were viewed, if nothing hid them; by default it could. ``distance``, where the surface is known exactly,
    gives the distances ``(P,)`` of points ``(P, 3)`` to it.
    """

    name: str
    frames: Indices
    view: Callable[[int], Surface]
    in_field: Callable[[FloatArray, Indices], Mask] = lambda points, _: np.ones(len(points), bool)
    distance: Callable[[FloatArray], FloatArray] | None = None


def thinned(points: FloatArray, voxel_m: float, order: Indices) -> Indices:
    """Of the points ``(P, 3)`` in each voxel the one that comes first in an order ``(P,)``: their indices.

    Args:
        points: ``(P, 3)``, metres.
        voxel_m: the side of a voxel.
        order: rows of all points ``(P,)``, the preferred ones first.
    """
    key = np.zeros(len(points), dtype=np.int64)
    for axis in points.T:  # one at a time, for there are millions
        key = (key << _KEY_BITS) | (
            np.floor(axis / voxel_m).astype(np.int64) + (1 << (_KEY_BITS - 1))
        )
    first: Indices = order[np.unique(key[order], return_index=True)[1]]
    return first


def stretches(T_world_camera: FloatArray, truth_frames: Indices) -> list[Indices]:
    """Frames of stretches of 100 m along a drive with known surface: all of them, or five evenly spread.

    Args:
        T_world_camera: true poses of all frames ``(N, 4, 4)``.
        truth_frames: frames that measured the surface; others count where the camera is within 5 m of one of them.
    """
    positions = T_world_camera[:, :3, 3]
    away, _ = cKDTree(positions[truth_frames]).query(positions)
    number = (path_distance(T_world_camera) / STRETCH_M).astype(np.int64)
    parts: list[Indices] = []
    for k in range(int(number[-1]) + 1):
        part = np.flatnonzero((number == k) & (away <= _NEAR_TRUTH_M))
        if len(part):
            parts.append(part)
    if len(parts) <= MOST_STRETCHES:
        return parts
    chosen = ((np.arange(MOST_STRETCHES) + 0.5) * len(parts) / MOST_STRETCHES).astype(np.intp)
    return [parts[k] for k in chosen]


def accumulated(truth: SurfaceTruth, views: Indices, positions: FloatArray) -> Surface:
    """The surface from all ``views``, one point in each voxel of 5 cm, one in an image where there is one.

    Of it what is in the box around ``positions`` ``(N, 3)`` of cameras and 30 m further.
    """
    margin = RANGE_M + _BEYOND_M
    low, high = positions.min(axis=0) - margin, positions.max(axis=0) + margin
    surfaces = [Surface(np.empty((0, 3)), np.empty(0, dtype=bool))]  # the first is thinned
    for number, frame in enumerate(views, 1):
        view = truth.view(int(frame))
        inside = ((view.points >= low) & (view.points <= high)).all(axis=1)
        surfaces.append(Surface(view.points[inside], view.in_image[inside]))
        waiting = sum(len(each.points) for each in surfaces[1:])
        if number == len(views) or waiting > _WAITING_POINTS:
            points = np.concatenate([each.points for each in surfaces])
            in_image = np.concatenate([each.in_image for each in surfaces])
            chosen = thinned(points, TRUTH_VOXEL_M, np.argsort(~in_image, kind="stable"))
            surfaces = [Surface(points[chosen], in_image[chosen])]
    return surfaces[0]


def backprojected(
    depth_m: FloatArray, rays: FloatArray, T_world_camera: FloatArray, range_m: float
) -> FloatArray:
    """Points ``(P, 3)`` in the world of z-depth ``(H, W)``, no further than ``range_m`` from the camera.

    Depth is 0 or not finite where unknown; ``rays`` ``(H, W, 3)`` go through every pixel, z = 1.
    """
    known = np.isfinite(depth_m) & (depth_m > 0)
    points = rays[known] * depth_m[known][:, None]
    near = points[np.linalg.norm(points, axis=1) <= range_m]
    return apply(T_world_camera, near)


class Within(Record):
    """A share or score for two limits of distance in metres."""

    m02: float | None = Field(default=None, alias="0.2")
    m05: float | None = Field(default=None, alias="0.5")


class SurfaceMetrics(Record):
    """Errors of points of a map and of the true surface.

    Of points that the truth's sensor could have seen, also their ``share``; of a ring around the nearest camera, its
    ends and numbers of points.
    """

    accuracy_median_m: float | None = None
    accuracy_90_m: float | None = None
    outlier_share: float | None = None
    completeness: float | None = None
    f_score: Within = part(Within)
    precision: Within = part(Within)
    recall: Within = part(Within)
    share: float | None = None
    from_m: float | None = None
    to_m: float | None = None
    map_points: Count | None = None
    surface_points: Count | None = None


class PlacedMetrics(SurfaceMetrics):
    """Errors of a map that was moved to the truth, by a motion with a ``scale`` or a rigid one."""

    in_field: SurfaceMetrics = part(SurfaceMetrics)
    by_distance: list[SurfaceMetrics] | None = None
    scale: float | None = None


def pose_similarity(
    T_world_camera_true: FloatArray, T_world_camera: FloatArray, with_scale: bool = True
) -> Similarity:
    """The similarity, or rigid motion, that takes a trajectory and its map to the truth, poses ``(N, 4, 4)`` both.

    Least squares of positions and of points 10 m from every camera: positions alone do not determine the roll about a
    straight road, which the map depends on.

    Args:
        T_world_camera_true: true poses ``(N, 4, 4)``.
        T_world_camera: estimated ones ``(N, 4, 4)``, row k beside row k.
        with_scale: whether a scale is fitted, or 1.
    """
    R_true, R_estimate = T_world_camera_true[:, :3, :3], T_world_camera[:, :3, :3]
    true, estimate = T_world_camera_true[:, :3, 3], T_world_camera[:, :3, 3]
    centred_true, centred = true - true.mean(axis=0), estimate - estimate.mean(axis=0)
    size_true, size = length_of(centred_true), length_of(centred)
    rough = size_true / size if with_scale and size > 0 else 1.0
    turns = (R_true @ np.swapaxes(R_estimate, 1, 2)).sum(axis=0)
    R = nearest_rotation(rough * centred_true.T @ centred + _LEVER_M**2 * turns)
    turned, energy = centred @ R.T, float((centred**2).sum())
    agreement = float((centred_true * turned).sum())
    scale = agreement / energy if with_scale and agreement > 0 else 1.0
    return Similarity(scale, R, true.mean(axis=0) - scale * R @ estimate.mean(axis=0))


@dataclass(frozen=True)
class MapDistances:
    """Errors in metres at samples of the map and of the true surface, and their distances to the nearest camera.

    ``to_surface``, ``map_range`` and ``in_field`` ``(M,)`` belong to map points, ``to_map`` and ``surface_range``
    ``(S,)`` to points of the true surface. ``in_field`` marks map points where the truth's sensor looked.
    """

    to_surface: FloatArray
    map_range: FloatArray
    in_field: Mask
    to_map: FloatArray
    surface_range: FloatArray


def compare(
    truth: SurfaceTruth, T_world_camera: FloatArray, maps: Mapping[str, FloatArray]
) -> tuple[dict[str, MapDistances], float]:
    """Distances between maps and the true surface by name, and the length of road looked at, stretch by stretch.

    Args:
        truth: the surface.
        T_world_camera: true poses of all frames ``(N, 4, 4)``.
        maps: points ``(P, 3)`` in the world of the true poses, by name; they share the cost of the truth.
    """
    parts = stretches(T_world_camera, truth.frames)
    step_m = VIEW_STEP_M if truth.distance is None else SPARSE_VIEW_STEP_M
    views = truth.frames[moved_rows(T_world_camera[truth.frames], step_m, VIEW_STEP_DEG)]
    cameras = cKDTree(T_world_camera[:, :3, 3])
    nearest = {
        name: cameras.query(points, distance_upper_bound=RANGE_M) for name, points in maps.items()
    }
    found: dict[str, list[tuple[NDArray[Any], ...]]] = {name: [] for name in maps}
    for stretch in parts:
        positions = T_world_camera[:, :3, 3]
        away_from_stretch, _ = cKDTree(positions[stretch]).query(positions[views])
        # the views that can see surfaces near the stretch
        near = views[away_from_stretch <= 2 * RANGE_M]
        to_surface, on_surface, surface_range = _surface_along(
            truth, near, T_world_camera, cameras, stretch
        )
        for name, points in maps.items():
            away, camera = nearest[name]
            own = _sampled(points, np.flatnonzero(np.isin(camera, stretch) & np.isfinite(away)))
            distances = to_surface(points[own]) if len(own) else np.empty(0)
            in_field, to_map = truth.in_field(points[own], near), _to_map(on_surface, points)
            found[name].append((distances, away[own], in_field, to_map, surface_range))
        del to_surface  # it holds the surface
    together = {
        name: MapDistances(*map(np.concatenate, zip(*each))) for name, each in found.items()
    }
    to_next = np.append(np.diff(path_distance(T_world_camera)), 0.0)
    return together, float(sum(to_next[part].sum() for part in parts))


def placed_errors(distances: MapDistances) -> dict[str, Any]:
    """`ERRORS` of a placed map, also by distance from the nearest camera."""
    own, true = distances.to_surface, distances.to_map
    in_field, near = distances.in_field, distances.surface_range < NEAR_CAMERA_M
    curve = []
    for from_m, to_m in BINS_M:
        of_map = (distances.map_range >= from_m) & (distances.map_range < to_m)
        of_surface = (distances.surface_range >= from_m) & (distances.surface_range < to_m)
        ring = _errors(own[of_map], true[of_surface], _LEAST_IN_BIN)
        counts = {"map_points": int(of_map.sum()), "surface_points": int(of_surface.sum())}
        curve.append({"from_m": from_m, "to_m": to_m} | ring | counts)
    share = _share(in_field) if len(in_field) else _NO_MAP
    fair = _errors(own[in_field], true[near], 1) | {"share": share}
    return _errors(own, true[near], 1) | {"in_field": fair, "by_distance": curve}


def _errors(own: FloatArray, true: FloatArray, least: int) -> dict[str, Any]:
    """Accuracy, completeness and F-scores of distances from the map and to it, missing below ``least`` points."""
    no_map = (_NO_MAP if least == 1 else _FEW) if len(own) < least else None
    no_surface = (_NO_SURFACE if least == 1 else _FEW) if len(true) < least else None
    precision: dict[str, Any] = {}
    recall: dict[str, Any] = {}
    f_score: dict[str, Any] = {}
    for key, within in F_SCORES_M.items():
        p: Any = no_map or _share(own <= within)
        r: Any = no_surface or _share(true <= within)
        precision[key], recall[key] = p, r
        f_score[key] = no_map or no_surface or 2 * p * r / (p + r or 1.0)
    return {
        "accuracy_median_m": no_map or median(own),
        "accuracy_90_m": no_map or float(np.quantile(own, 0.9)),
        "outlier_share": no_map or _share(own > OUTLIER_M),
        "completeness": no_surface or _share(true <= COVERED_WITHIN_M),
        "f_score": f_score,
        "precision": precision,
        "recall": recall,
    }


def _share(which: Mask) -> float:
    return float(which.mean())


def _sampled(points: FloatArray, candidates: Indices) -> Indices:
    """Of the candidates, a random one of each 0.2 m voxel."""
    order = np.random.default_rng(0).permutation(len(candidates))
    return candidates[thinned(points[candidates], SAMPLE_VOXEL_M, order)]


def _surface_along(
    truth: SurfaceTruth,
    views: Indices,
    T_world_camera: FloatArray,
    cameras: cKDTree,
    stretch: Indices,
) -> tuple[Callable[[FloatArray], FloatArray], FloatArray, FloatArray]:
    """The true surface around a stretch, from these views, as the function from points ``(P, 3)`` to their distances.

    With it samples ``(S, 3)`` of what images show of it whose nearest camera is on the stretch, and that distance.
    """
    surface = accumulated(truth, views, T_world_camera[stretch, :3, 3])
    samples = surface.points[_sampled(surface.points, np.flatnonzero(surface.in_image))]
    away, camera = cameras.query(samples, distance_upper_bound=RANGE_M)
    own = np.flatnonzero(np.isfinite(away) & np.isin(camera, stretch))
    if truth.distance is not None:
        return truth.distance, samples[own], away[own]
    tree = cKDTree(surface.points, leafsize=_LEAF_POINTS)
    return lambda points: np.asarray(tree.query(points)[0]), samples[own], away[own]


def _to_map(samples: FloatArray, points: FloatArray) -> FloatArray:
    """Distances from samples ``(S, 3)`` of the surface to the map ``(P, 3)``; infinite beyond 1 m."""
    if len(samples) == 0:
        return np.empty(0)
    low, high = samples.min(axis=0) - OUTLIER_M, samples.max(axis=0) + OUTLIER_M
    near = points[((points >= low) & (points <= high)).all(axis=1)]
    return cKDTree(near).query(samples, distance_upper_bound=OUTLIER_M)[0]


def double_wall_share(pieces: Iterable[tuple[FloatArray, IntArray]]) -> float:
    """Share of the area with a parallel surface 0.3 to 2 m before it; NaN without any area.

    Args:
        pieces: vertices ``(V, 3)`` and triangles ``(T, 3)``, whose normals look to where the camera was.
    """
    found = total = 0.0
    for vertices, triangles in pieces:
        corners = vertices[triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled_area = np.linalg.norm(normal, axis=1)
        chosen = np.flatnonzero(doubled_area > 0)
        chosen = chosen[:: -(-len(chosen) // _MOST_RAYS) or 1]
        direction = normal[chosen] / doubled_area[chosen, None]
        rays = np.concatenate(
            [corners[chosen].mean(axis=1) + _WALL_NEAR_M * direction, direction], axis=1
        )
        scene = scene_of(vertices.astype(np.float32), triangles.astype(np.uint32))
        answer = scene.cast_rays(import_open3d().core.Tensor(rays.astype(np.float32)))
        cosine = (answer["primitive_normals"].numpy() * direction).sum(axis=1)
        is_double = (answer["t_hit"].numpy() <= _WALL_FAR_M - _WALL_NEAR_M) & (cosine > _PARALLEL)
        weight = doubled_area.sum() / max(doubled_area[chosen].sum(), np.finfo(float).tiny)
        found += weight * float(doubled_area[chosen][is_double].sum())
        total += float(doubled_area.sum())
    return found / total if total > 0 else float("nan")
