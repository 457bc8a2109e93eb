"""Files: those of a run folder by name and meaning, atomic writes with one line of error, and places that hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from erfsfm.common import files
from erfsfm.common.readers.camera_file import CAMERA_FILE
from slam.runtime.errors import SlamError

CONFIG = "config.yaml"
MASK = "mask.png"
METRICS = "metrics.json"
GRAPH = "graph.g2o"
LOOPS = "loops.json"
PLACES = "places.npz"
MAP_MESH = "map_mesh.ply"
MAP_CLOUD = "map_cloud.ply"
REPORT = "report.html"
LOG = "run.log"

REFERENCE = "reference"
TRAJECTORIES = {
    "network": "poses of the networks' snippets, chained",
    "odometry": "front end fused, no loops",
    "optimised": "after the pose graph",
    "lidar": "KISS-ICP on the LiDAR scans",
}
FORMATS = ("kitti", "tum")


def trajectory_file(name: str, format: str) -> str:
    """File of ``reference`` or of one of `TRAJECTORIES` in one of `FORMATS`."""
    return f"{name if name == REFERENCE else f'trajectory_{name}'}.{format}.txt"


ESTIMATE = trajectory_file("optimised", "tum")  # a folder that holds it holds a run

MEANINGS = {
    CONFIG: "resolved configuration",
    CAMERA_FILE: "camera as found, or with the mask that was found, for a next run",
    MASK: "what is fixed to the camera, black",
    METRICS: "every number of this page",
    GRAPH: "pose graph",
    LOOPS: "accepted and rejected loops",
    PLACES: "features of places, for localize",
    MAP_MESH: "map as a mesh, y down",
    MAP_CLOUD: "map as a coloured cloud, y down",
    REPORT: "this page",
    LOG: "log of the run",
} | {
    trajectory_file(name, format): meaning
    for name, meaning in (TRAJECTORIES | {REFERENCE: "ground truth"}).items()
    for format in FORMATS
}
"""Every file that a run may leave, by name."""


def write_atomically(
    path: Path,
    content: str | bytes | Callable[[Path], object],
    error: type[SlamError] = SlamError,
    sync: bool = True,
) -> None:
    """`erfsfm.common.files.write_atomically` that raises a `SlamError`.

    Raises:
        SlamError: (or the given kind) the file cannot be written.
    """
    try:
        files.write_atomically(path, content, sync)
    except OSError as cause:
        raise error(str(cause)) from cause


def source_from_anywhere(source: str) -> str:
    """``depth.source`` with its file or folder, where it has one, by the whole path."""
    kind, colon, path = source.partition(":")
    return f"{kind}:{from_anywhere(path)}" if colon else source


def from_anywhere(name_or_path: str | Path) -> str:
    """A file or folder that is there by its whole path, which holds in any folder; all else as it is."""
    path = Path(name_or_path)
    return str(path.absolute() if path.exists() else name_or_path)
