"""Interactive figures of the report, by Plotly. A line without a colour has that of text.

The map is a thinned surface with the camera's path, and where it is seen from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly import graph_objects as go
from plotly.subplots import make_subplots
from scipy.spatial.transform import Rotation

from slam.evaluation.trajectory import FIGURE_LENGTHS_M, aligned, paired, segment_errors
from slam.formats.ply import R_UP_WORLD
from slam.formats.trajectory import Trajectory, associate
from slam.geometry.se3 import FloatArray, IntArray, apply, invert, path_distance, rotation_angle
from slam.results.folder import RunFolder
from slam.results.metrics import AcceptedLoop, Stretch
from slam.runtime.errors import RunError
from slam.runtime.files import MAP_MESH, REFERENCE
from slam.runtime.imports import import_open3d

# Okabe and Ito (2008): for every eye
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
LOOKS: dict[
    str, tuple[str, str | None, float, str]
] = {  # label, colour (None: that of text), width, dash
    REFERENCE: ("Ground truth", None, 1.2, "dash"),
    "network": ("Network, chained", "#e69f00", 1.3, "solid"),
    "odometry": ("Odometry", "#cc79a7", 1.5, "dashdot"),
    "optimised": ("Optimised", "#0072b2", 2.0, "solid"),
    "lidar": ("LiDAR (KISS-ICP)", "#009e73", 1.8, "dot"),
}
_STRETCHES = 25  # of a path, over which lengths are compared
_MAP, _PANEL = 560, 230  # heights, px
_SKY = "#e2e8ef"
_TRIANGLES = 60_000  # that a browser turns smoothly, in a page of 3 to 6 MB
_COARSER = 1.15  # vertices of one surface do not all meet in its cells
_FINER = 2  # triangles that quadric errors choose from, as a multiple of those that stay
_MOST_TRIANGLES = 1_000_000  # that are thinned by quadric errors; a larger mesh is clustered first
_CANDIDATES = 9
_SEEN_WITHIN = 40.0
_NEAR_PERCENT = 10
_HALF_FIELD = np.array([0.9, 0.5])  # tangents, of width and height

Mesh = tuple[FloatArray, NDArray[np.uint8], IntArray]
"""Vertices ``(V, 3)`` in the world, y down, their RGB colours ``(V, 3)``, and triangles ``(T, 3)``."""


def trajectories_figure(
    trajectories: Mapping[str, Trajectory], unit: str, loops: Sequence[AcceptedLoop] = ()
) -> go.Figure:
    """Trajectories from above, `aligned`; places of accepted loops are marked on the optimised one."""
    trajectories = aligned(trajectories)
    figure = go.Figure()
    for name, trajectory in trajectories.items():
        where = f"x %{{x:.2f}}, z %{{y:.2f}} {unit}"
        x, _, z = trajectory.positions.T
        figure.add_trace(_line(name, x, z, _frames(trajectory, trajectories), where))
    if loops and "optimised" in trajectories:
        at = trajectories["optimised"].positions[[loop.to for loop in loops]]
        text = [
            f"loop: frame {loop.to} is where frame {loop.from_} was, {loop.reason}"
            for loop in loops
        ]
        marker = {"symbol": "circle-open", "size": 9, "color": COLOURS[1]}
        x, _, z = map(_single, at.T)
        figure.add_scatter(
            x=x, y=z, mode="markers", name="Loops", marker=marker, text=text, hoverinfo="text"
        )
    figure.update_xaxes(title=f"x, right ({unit})")
    figure.update_yaxes(title=f"z, ahead ({unit})", scaleanchor="x")
    return figure.update_layout(height=_MAP, hovermode="closest", dragmode="pan")


def map_figure(view: MapView) -> go.Figure:
    """The map in its colours with the camera's path through it, seen first from one of its places."""
    points = view.points @ R_UP_WORLD.T
    path = view.T_world_camera[:, :3, 3] @ R_UP_WORLD.T
    corners = view.triangles.astype(np.uint16 if len(points) < 2**16 else np.int32)
    colours = [f"#{rgb:06x}" for rgb in view.colours.astype(np.int64) @ [1 << 16, 1 << 8, 1]]
    flat = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
    figure = go.Figure(
        go.Mesh3d(
            **_by_axis("xyz", map(_single, points.T)),
            **_by_axis("ijk", map(np.ascontiguousarray, corners.T)),
            vertexcolor=colours,
            lighting=flat,
            hoverinfo="skip",
        )
    )
    line = {"color": COLOURS[0], "width": 4}
    figure.add_scatter3d(
        **_by_axis("xyz", map(_single, path.T)), mode="lines", line=line, hoverinfo="skip"
    )
    # a unit of the scene is what is near, for it is clipped at a hundredth of one
    shown = np.concatenate([points, path])
    low, high = shown.min(axis=0), shown.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    eye, forward = path[view.frame], R_UP_WORLD @ view.T_world_camera[view.frame, :3, 2]
    places = {"eye": eye, "center": eye + view.ahead * forward}
    ranges = zip(low.tolist(), (low + size).tolist())
    scene: dict[str, Any] = _by_axis(
        ("xaxis", "yaxis", "zaxis"), ({"visible": False, "range": list(each)} for each in ranges)
    )
    scene |= {
        "camera": {
            name: _by_axis("xyz", ((X - 0.5 * (low + high)) / view.ahead).tolist())
            for name, X in places.items()
        },
        "aspectratio": _by_axis("xyz", (size / view.ahead).tolist()),
        "aspectmode": "manual",
        "dragmode": "turntable",
        "bgcolor": _SKY,
    }
    return figure.update_layout(
        scene=scene, height=_MAP, showlegend=False, margin={"l": 0, "r": 0, "t": 0, "b": 0}
    )


def error_figure(trajectories: Mapping[str, Trajectory]) -> go.Figure:
    """Distance to the true position over the distance travelled, after the 7-dof alignment."""
    figure = go.Figure()
    for name, estimate, truth in paired(trajectories):
        error = np.linalg.norm(estimate.positions - truth.positions, axis=1)
        path, frames = path_distance(truth.T_world_camera), _frames(truth, trajectories)
        figure.add_trace(_line(name, path, error, frames, "%{y:.3f} m off after %{x:.1f} m"))
    figure.update_xaxes(title="distance travelled (m)")
    figure.update_yaxes(title="position error (m)", rangemode="tozero")
    return figure.update_layout(height=_PANEL + 90)


def drift_figure(trajectories: Mapping[str, Trajectory]) -> go.Figure:
    """Relative errors over the length of segments, after the 7-dof alignment."""
    figure = _panels("translation (%)", "rotation (deg / 100 m)")
    for name, estimate, truth in paired(trajectories):
        segments = segment_errors(estimate.T_world_camera, truth.T_world_camera, FIGURE_LENGTHS_M)
        lengths = np.array([length_m for length_m, _, _ in segments])
        percent = 100.0 * np.array([shift_m.mean() for _, shift_m, _ in segments]) / lengths
        degrees = 100.0 * np.rad2deg([turn.mean() for _, _, turn in segments]) / lengths
        look = {"mode": "lines+markers"}
        figure.add_trace(_line(name, lengths, percent, None, "%{y:.2f} % of %{x} m", **look), 1, 1)
        words = "%{y:.3f} deg / 100 m over %{x} m"
        figure.add_trace(_line(name, lengths, degrees, None, words, showlegend=False, **look), 2, 1)
    figure.update_xaxes(title="segment length (m)", row=2)
    return figure.update_yaxes(rangemode="tozero")


def scale_figure(
    trajectories: Mapping[str, Trajectory], is_metric: bool, gaps: Iterable[Stretch]
) -> go.Figure:
    """Lengths over the true ones, and the error of the rotation, over time; gaps are shaded.

    Where lengths are metric those of all but the network are taken as written, else after the 7-dof alignment.
    """
    figure, reference = (
        _panels("length / true length", "rotation error (deg)"),
        trajectories[REFERENCE],
    )
    for name, estimate, truth in paired(trajectories):
        measured = (
            associate(trajectories[name], reference)[0]
            if is_metric and name != "network"
            else estimate
        )
        frames, seconds = _frames(truth, trajectories), truth.stamps - reference.stamps[0]
        true_path, path = (
            path_distance(truth.T_world_camera),
            path_distance(measured.T_world_camera),
        )
        ends = np.searchsorted(true_path, true_path + true_path[-1] / _STRETCHES)
        starts = np.flatnonzero(ends < len(path))
        ends = ends[starts]
        true_length = true_path[ends] - true_path[starts]
        ratio = (path[ends] - path[starts]) / np.where(true_length > 0, true_length, np.nan)
        middle = (starts + ends) // 2
        figure.add_trace(
            _line(name, seconds[middle], ratio, frames[middle], "%{y:.3f} at %{x:.1f} s"), 1, 1
        )
        turned = (
            np.swapaxes(truth.T_world_camera[:, :3, :3], 1, 2) @ estimate.T_world_camera[:, :3, :3]
        )
        off = np.rad2deg(rotation_angle(turned))
        line = _line(name, seconds, off, frames, "%{y:.2f} deg at %{x:.1f} s", showlegend=False)
        figure.add_trace(line, 2, 1)
    figure.update_yaxes(rangemode="tozero", row=2)
    return _over_time(figure, reference, gaps)


def motion_figure(
    trajectories: Mapping[str, Trajectory], unit: str, gaps: Iterable[Stretch]
) -> go.Figure:
    """Speed, and angles of the optimised trajectory, over time: what shows of scale and rotation without truth."""
    figure, drawn = _panels(f"speed ({unit} / s)", "angles (deg)"), aligned(trajectories)
    last = drawn.get("optimised") or next(iter(drawn.values()))
    for name, trajectory in drawn.items():
        steps, seconds = (
            np.diff(trajectory.positions, axis=0),
            trajectory.stamps[1:] - last.stamps[0],
        )
        speed = np.linalg.norm(steps, axis=1) / np.maximum(np.diff(trajectory.stamps), 1e-9)
        frames = _frames(trajectory, drawn)[1:]
        figure.add_trace(_line(name, seconds, speed, frames, "%{y:.3f} at %{x:.1f} s"), 1, 1)
    angles = np.unwrap(Rotation.from_matrix(last.T_world_camera[:, :3, :3]).as_euler("YXZ"), axis=0)
    for name, colour, values in zip(("Yaw", "Pitch", "Roll"), COLOURS[1:], np.rad2deg(angles).T):
        frames, seconds = _frames(last, drawn), last.stamps - last.stamps[0]
        words, look = "%{y:.2f} deg at %{x:.1f} s", {"color": colour, "width": 1.6}
        figure.add_trace(_line(name, seconds, values, frames, words, line=look), 2, 1)
    return _over_time(figure, last, gaps)


def _line(
    name: str, x: FloatArray, y: FloatArray, frames: Any, words: str, **more: Any
) -> go.Scatter:
    """A line of a trajectory, which tells the frame under the pointer."""
    label, colour, width, dash = LOOKS.get(name, (name, None, 1.8, "solid"))
    line = {"width": width, "dash": dash} | ({} if colour is None else {"color": colour})
    words = f"{'' if frames is None else 'frame %{customdata}: '}{words}<extra>{label}</extra>"
    given = {
        "mode": "lines",
        "customdata": frames,
        "line": line,
        "name": label,
        "legendgroup": name,
        **more,
    }
    return go.Scatter(x=_single(x), y=_single(y), hovertemplate=words, **given)


def _frames(trajectory: Trajectory, among: Mapping[str, Trajectory]) -> Any:
    """The frame of every row: the row of the same stamp in the longest trajectory."""
    longest = max(among.values(), key=lambda each: len(each.stamps))
    return np.searchsorted(longest.stamps, trajectory.stamps - 1e-6).astype(np.int32)


def _panels(*titles: str) -> go.Figure:
    """Axes below each other over one x."""
    figure = make_subplots(len(titles), 1, shared_xaxes=True, vertical_spacing=0.07)
    for row, title in enumerate(titles, 1):
        figure.update_yaxes(title=title, row=row)
    return figure.update_layout(height=_PANEL * len(titles) + 40)


def _over_time(figure: go.Figure, trajectory: Trajectory, gaps: Iterable[Stretch]) -> go.Figure:
    for gap in gaps:
        ends = trajectory.stamps[[max(gap.first - 1, 0), min(gap.last + 1, len(trajectory) - 1)]]
        figure.add_vrect(
            *(ends - trajectory.stamps[0]), fillcolor="#8b949e", opacity=0.25, line_width=0
        )
    return figure.update_xaxes(title="time (s)", row=2)


def _by_axis(names: Iterable[str], values: Iterable[Any]) -> dict[str, Any]:
    return dict(zip(names, values, strict=True))


def _single(values: FloatArray) -> Any:
    return np.asarray(values, np.float32)


@dataclass(frozen=True)
class MapView:
    """A `Mesh`, the poses of the camera ``(N, 4, 4)`` in its world, the ``frame`` from which it
    is seen first, and how far ``ahead`` of it the map is near."""

    points: FloatArray
    colours: NDArray[np.uint8]
    triangles: IntArray
    T_world_camera: FloatArray
    frame: int
    ahead: float


def map_view(folder: RunFolder, triangles: int = _TRIANGLES) -> MapView | None:
    """The map with at most about so many triangles; None without ``map_mesh.ply``.

    It is seen from that one of nine frames, evenly spread over the path, before which most vertices lie.
    """
    trajectory = folder.trajectory("optimised")
    if trajectory is None or not (folder.path / MAP_MESH).is_file():
        return None
    points, colours, corners = thinned_mesh(folder.path / MAP_MESH, triangles)
    poses = trajectory.T_world_camera
    frames = np.unique(
        np.linspace(0, len(poses) - 1, _CANDIDATES + 2)[1:-1].round().astype(int)
    ).tolist()
    depths = [_depths(points, poses[frame]) for frame in frames]
    best = int(np.argmax([np.count_nonzero(z < _SEEN_WITHIN) for z in depths]))
    ahead = float(np.percentile(depths[best], _NEAR_PERCENT)) if len(depths[best]) else _SEEN_WITHIN
    return MapView(points, colours, corners, poses, frames[best], ahead)


def thinned_mesh(path: Path, triangles: int) -> Mesh:
    """A ``map_mesh.ply`` with at most about so many triangles, by quadric errors; a large one is clustered first."""
    mesh = import_open3d().io.read_triangle_mesh(str(path))
    if not mesh.has_triangles():
        raise RunError(f"{path} is no mesh that can be read: run the sequence again")
    if len(mesh.triangles) > max(_MOST_TRIANGLES, _FINER * triangles):
        mesh = mesh.simplify_vertex_clustering(
            _COARSER * np.sqrt(2.0 * mesh.get_surface_area() / (_FINER * triangles))
        )
    if len(mesh.triangles) > triangles:
        mesh = mesh.simplify_quadric_decimation(triangles)
        mesh = mesh.remove_degenerate_triangles().remove_unreferenced_vertices()
    rgb = np.rint(255.0 * np.clip(mesh.vertex_colors, 0.0, 1.0)).astype(np.uint8)
    return np.asarray(mesh.vertices), rgb, np.asarray(mesh.triangles).astype(np.int64)


def _depths(points: FloatArray, T_world_camera: FloatArray) -> FloatArray:
    """Depths of the points ``(P, 3)`` that lie in the field of view."""
    X = apply(invert(T_world_camera), points)
    inside = (X[:, 2] > 0) & (abs(X[:, :2]) < _HALF_FIELD * X[:, 2:]).all(axis=1)
    return X[inside, 2]
