"""One monocular run of ORB-SLAM3 by its wheel; for the Python of an environment that has pyorbslam3, and NumPy alone.

``FOLDER`` holds ``recording.json`` (camera, stamps, number of features) and ``frames.raw`` (grey images one after
another); ``trajectory.tum`` and ``record.json`` are written to it.

Example: ORB_ENV/bin/python tools/benchmarking/orbslam3.py FOLDER VOCABULARY PACE
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pyorbslam3

_EXTRACTOR = {"scaleFactor": 1.2, "nLevels": 8, "iniThFAST": 20, "minThFAST": 7}  # of its own examples
_VIEWER = {"KeyFrameSize": 0.1, "KeyFrameLineWidth": 1.0, "GraphLineWidth": 1.0, "PointSize": 2.0, "CameraSize": 0.1}
_VIEWER |= {"CameraLineWidth": 2.0, "ViewpointX": 0.0, "ViewpointY": -10.0, "ViewpointZ": -0.1, "ViewpointF": 2000.0}


def main(folder: Path, vocabulary: str, pace: float) -> None:
    """Track every frame at ``pace`` times the speed of the recording; 0 waits for nothing."""
    recording = json.loads((folder / "recording.json").read_text())
    settings = folder / "settings.yaml"
    settings.write_text(_settings(recording))
    slam = pyorbslam3.Slam(vocabulary, str(settings), pyorbslam3.Sensor.MONOCULAR, use_viewer=False)
    start_s = _cpu_seconds()
    height, width, stamps = recording["height"], recording["width"], recording["stamps"]
    points = []
    with (folder / "frames.raw").open("rb") as frames:
        for stamp, following in zip(stamps, [*stamps[1:], stamps[-1]]):
            image = np.frombuffer(frames.read(height * width), np.uint8).reshape(height, width)
            begin = time.perf_counter()
            found = slam.track_monocular(image, stamp)
            if found.pose_valid:
                points.append(int(found.num_tracked_points))
            if pace:
                time.sleep(max(0.0, (following - stamp) / pace - (time.perf_counter() - begin)))
    slam.shutdown()
    record = {"start_cpu_s": start_s, "cpu_s": _cpu_seconds() - start_s, "points": median(points) if points else 0}
    record["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    if points:
        slam.save_trajectory_euroc(str(folder / "all.txt"))
        slam.save_keyframe_trajectory_tum(str(folder / "keyframes.tum"))
        rows = np.loadtxt(folder / "all.txt", ndmin=2)
        rows[:, 0] /= 1e9  # it writes nanoseconds
        np.savetxt(folder / "trajectory.tum", rows, fmt="%.9f")
        record["keyframes"] = len((folder / "keyframes.tum").read_text().splitlines())
    (folder / "record.json").write_text(json.dumps(record))
    sys.stdout.flush()
    os._exit(0)  # its threads may still hold on to a display


def _settings(recording: dict[str, Any]) -> str:
    values: dict[str, Any] = {"File.version": '"1.0"', "Camera.type": '"PinHole"'}
    values |= {f"Camera1.{key}": float(recording[key]) for key in ("fx", "fy", "cx", "cy")}
    values |= {f"Camera1.{key}": 0.0 for key in ("k1", "k2", "p1", "p2")}
    values |= {f"Camera.{key}": recording[key] for key in ("width", "height", "fps")} | {"Camera.RGB": 1}
    values |= {"ORBextractor.nFeatures": recording["features"]}
    values |= {f"ORBextractor.{key}": value for key, value in _EXTRACTOR.items()}
    values |= {f"Viewer.{key}": value for key, value in _VIEWER.items()}
    return "%YAML:1.0\n" + "".join(f"{key}: {value}\n" for key, value in values.items())


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
