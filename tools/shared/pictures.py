"""Trajectories from above by matplotlib, and the map by casting rays at it, for the pictures of README and docs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from numpy.typing import NDArray

from slam.evaluation.drift import aligned
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.report.figures import LOOKS
from slam.results.report.map_view import MapMesh
from slam.runtime.imports import import_open3d
from slam.runtime.run_files import REFERENCE, TRAJECTORIES

STYLE: dict[str, Any] = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True}
STYLE |= {"axes.axisbelow": True, "grid.color": "#e3e6ea", "legend.fontsize": 9, "legend.frameon": False}
SKY = (226, 232, 239)
_DASHES = {"dash": "dashed", "dot": "dotted"}


def trajectories_of(folder: RunFolder) -> dict[str, Trajectory]:
    """The trajectories of a run, the reference first."""
    found = {name: folder.trajectory(name) for name in (REFERENCE, *TRAJECTORIES)}
    return {name: trajectory for name, trajectory in found.items() if trajectory is not None}


def draw_trajectories(canvas: FigureBase, trajectories: Mapping[str, Trajectory], unit: str) -> Axes:
    """Draw them on a figure or a part of one, aligned to the reference where there is one."""
    axes = canvas.subplots()
    for name, trajectory in aligned(trajectories).items():
        label, colour, width, dash = LOOKS[name]
        look: dict[str, Any] = {"color": colour or "black", "linewidth": width, "linestyle": _DASHES.get(dash, dash)}
        axes.plot(trajectory.positions[:, 0], trajectory.positions[:, 2], label=label, **look)
    axes.set(xlabel=f"x, right ({unit})", ylabel=f"z, ahead ({unit})")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.legend()
    return axes


def cast(mesh: MapMesh, origins: FloatArray, directions: FloatArray) -> NDArray[np.uint8]:
    """Colours ``(H, W, 3)`` where rays ``(H, W, 3)`` meet a mesh, and of the sky elsewhere."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.points.astype(np.float32), mesh.triangles.astype(np.uint32))
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor(rays))
    reached = np.isfinite(hit["t_hit"].numpy())
    u, v = hit["primitive_uvs"].numpy()[reached].T
    corners = mesh.colours[mesh.triangles[hit["primitive_ids"].numpy()[reached]]].astype(np.float32)
    picture = np.tile(np.array(SKY, np.uint8), (*reached.shape, 1))
    mixed = np.einsum("pc,pcr->pr", np.stack([1.0 - u - v, u, v], axis=1), corners)
    picture[reached] = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return picture
