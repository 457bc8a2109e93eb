"""The files of a run folder: their names and what each of them is."""

from __future__ import annotations

CONFIG = "config.yaml"
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
    "network": "raw network poses, chained",
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
