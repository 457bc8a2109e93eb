"""Meshes and clouds cropped, thinned, simplified and rotated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slam.commands.exports.options import Crop, ExportOptions
from slam.formats.ply import Ply, coloured_ply
from slam.runtime.errors import RunError
from slam.runtime.imports import import_open3d

_MOST_CUBES = 1e9  # along an axis: Open3D counts them in 32 bits


def prepared(ply: Ply, options: ExportOptions) -> Ply:
    """Crop, then thin or resample, then simplify, as far as the options ask for it.

    Raises:
        RunError: nothing is left.
    """
    if len(ply.vertices) == 0 or (ply.triangles is not None and len(ply.triangles) == 0):
        raise RunError("the map is empty: there is nothing to export")
    if options.crop is not None:
        ply = cropped(ply, options.crop)
    if options.voxel is not None:
        ply = _thinned(ply, options.voxel)
    if options.triangles is not None and ply.triangles is not None and options.triangles < len(ply.triangles):
        count = options.triangles
        ply = _through_open3d(ply, lambda mesh: mesh.simplify_quadric_decimation(count))
        if ply.triangles is None or len(ply.triangles) == 0:
            raise RunError(f"--triangles {count} leaves nothing of the mesh: give a larger number")
    return ply


def cropped(ply: Ply, crop: Crop) -> Ply:
    """The points inside; of a mesh the triangles with all corners inside.

    Raises:
        RunError: there are none.
    """
    points = ply.points
    inside = crop.contains(points)
    if ply.triangles is not None:
        triangles = ply.triangles[inside[ply.triangles].all(axis=1)]
        used, renumbered = np.unique(triangles, return_inverse=True)
        kept = Ply(ply.vertices[used], renumbered.reshape(-1, 3).astype(np.int64))
    else:
        kept = Ply(ply.vertices[inside])
    if len(kept.vertices) == 0:
        sides = zip("xyz", points.min(axis=0), points.max(axis=0), strict=True)
        extent = ", ".join(f"{axis} {low:.1f} to {high:.1f}" for axis, low, high in sides)
        raise RunError(f"nothing of the map lies inside --crop: it reaches over {extent}")
    return kept


def _thinned(ply: Ply, voxel: float) -> Ply:
    """One vertex or point a cube of this side: the mean of those inside, and of their colours."""
    wide = float(np.ptp(ply.points, axis=0).max())
    if wide / voxel > _MOST_CUBES:
        raise RunError(f"--voxel {voxel:g} is too small for a map that is {wide:.3g} wide: give a larger length")
    if ply.triangles is None:
        return _through_open3d(ply, lambda cloud: cloud.voxel_down_sample(voxel))
    thin = _through_open3d(ply, lambda mesh: mesh.simplify_vertex_clustering(voxel))
    if thin.triangles is None or len(thin.triangles) == 0:
        raise RunError(f"--voxel {voxel:g} leaves no triangle of the mesh: give a smaller length")
    return thin


def _through_open3d(ply: Ply, change: Any) -> Ply:
    """Convert, change, convert back; fields that Open3D does not know are those of the nearest vertex before."""
    o3d = import_open3d()
    vector = o3d.utility.Vector3dVector
    shades = vector(ply.colours_or_grey / 255.0)
    is_mesh = ply.triangles is not None
    if ply.triangles is not None:
        corners = o3d.utility.Vector3iVector(ply.triangles.astype(np.int32))  # others are converted one by one
        source = o3d.geometry.TriangleMesh(vector(ply.points), corners)
        source.vertex_colors = shades
    else:
        source = o3d.geometry.PointCloud(vector(ply.points))
        source.colors = shades
        if ply.normals is not None:
            source.normals = vector(ply.normals)
    result = change(source)
    if is_mesh:
        result.remove_degenerate_triangles().remove_unreferenced_vertices().compute_vertex_normals()
        points, normals, shades = result.vertices, result.vertex_normals, result.vertex_colors
        triangles: NDArray[np.int64] | None = np.asarray(result.triangles).astype(np.int64)
    else:
        points, shades, triangles = result.points, result.colors, None
        normals = result.normals if result.has_normals() else np.zeros((len(points), 3))
    changed = coloured_ply(np.asarray(points), np.asarray(normals), np.asarray(shades), triangles)
    return _with_extra_fields(changed, ply)


def _with_extra_fields(changed: Ply, source: Ply) -> Ply:
    names = source.extra_fields()
    if not names or len(changed.vertices) == 0:
        return changed
    _, nearest = cKDTree(source.points).query(changed.points)
    kinds = [(name, changed.vertices.dtype[name]) for name in changed.vertices.dtype.names or ()]
    vertices = np.empty(len(changed.vertices), [*kinds, *((name, source.vertices.dtype[name]) for name in names)])
    for name, _ in kinds:
        vertices[name] = changed.vertices[name]
    for name in names:
        vertices[name] = source.vertices[name][nearest]
    return replace(changed, vertices=vertices)
