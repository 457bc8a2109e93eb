"""The parts of a run that can be exported: the options each takes, and what it may replace."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.commands.exports.nerfstudio import POINTS
from slam.formats.colmap import BINARY_FOLDER, MODEL_FILES, is_own_model
from slam.formats.ros_map import describes_map
from slam.formats.transforms import TRANSFORMS, is_own_scene
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.output_file import check_replaced
from slam.runtime.errors import RunError
from slam.runtime.run_files import CONFIG

# from a camera's x right, y down, z ahead
R_UP_WORLDS: dict[str, FloatArray] = {
    "y-down": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),  # x right, y ahead, z up
}


@dataclass(frozen=True)
class FolderPart:
    """A part of several files: what it is in words, their names, and whether those in a folder are ours."""

    noun: str
    names: tuple[str, ...]
    is_own: Callable[[Path], bool]


@dataclass(frozen=True)
class Part:
    """A part of a run.

    Attributes:
        options: that have an effect.
        beginnings: of a file: the ends that its name may have, and how such a file begins.
        folder: of several files.
    """

    options: tuple[str, ...] = ()
    beginnings: Mapping[str, bytes] = field(default_factory=dict)
    folder: FolderPart | None = None


PARTS = {
    "mesh": Part((), {".ply": b"ply"}),
    "cloud": Part((), {".ply": b"ply"}),
    "colmap": Part(
        ("dataset", "points"),
        folder=FolderPart("a COLMAP model", ("images", BINARY_FOLDER, *MODEL_FILES), is_own_model),
    ),
    "nerfstudio": Part(("dataset",), folder=FolderPart("a scene", ("images", POINTS, TRANSFORMS), is_own_scene)),
    "occupancy": Part(("resolution",), {".yaml": b"", ".pgm": b"P5"}),
}


def check_options(what: str, up: str, resolution: float | None, dataset: Path | None, points: int | None) -> None:
    """Refuse what does not exist, has no effect or makes no sense.

    Raises:
        RunError: one line.
    """
    if what not in PARTS:
        raise RunError(f"--what {what!r} is unknown: choose one of {', '.join(PARTS)}")
    if up not in R_UP_WORLDS:
        raise RunError(f"--up {up!r} is unknown: choose {' or '.join(R_UP_WORLDS)}")
    for name, value in {"resolution": resolution, "dataset": dataset, "points": points}.items():
        if value is not None and name not in PARTS[what].options:
            takers = ", ".join(taker for taker, part in PARTS.items() if name in part.options)
            raise RunError(f"--{name} does nothing for {what}: it is for {takers}")
    if resolution is not None and not (math.isfinite(resolution) and resolution > 0):
        raise RunError(f"--resolution {resolution} must be a positive length")
    if points is not None and points < 1:
        raise RunError(f"--points {points} is too few: give 1 or more")


def check_target(folder: RunFolder, what: str, output: Path) -> None:
    """Check an ``output`` before anything is computed.

    Raises:
        RunError: it is a folder where a file is wanted or the reverse, a file of a run or of the run's recording, or
            what would be replaced is something else.
    """
    part = PARTS[what]
    if part.folder is not None:
        if output.exists() and not output.is_dir():
            raise RunError(f"{output} is a file: {part.folder.noun} is several files, give the name of a folder")
        others = [name for name in part.folder.names if (output / name).exists()]
        if others and not part.folder.is_own(output):
            raise RunError(f"{output / others[0]} is none of ours and would be replaced: choose another --output")
        return
    if output.suffix.lower() not in part.beginnings:
        named = " or ".join(part.beginnings)
        raise RunError(f"{what} is written as {named}; got '{output.name}', give a name that ends so")
    files = [output]
    if what == "occupancy":
        files = [output.with_suffix(suffix) for suffix in part.beginnings]
        present = [path for path in files if path.is_file() and path.stat().st_size]
        if present and not describes_map(files[0]):
            raise RunError(f"{present[0]} exists and is no map of ROS: choose another --output")
    for path in files:
        check_replaced(path, part.beginnings)
        if path.is_file() and _is_in_recording(folder, path):
            raise RunError(f"{path} belongs to the recording of the run: choose another --output")


def _is_in_recording(folder: RunFolder, output: Path) -> bool:
    """Whether a file lies in the folder that was run, and was there before the run."""
    began = folder.path / CONFIG
    if not began.is_file() or output.stat().st_mtime > began.stat().st_mtime:
        return False
    dataset = folder.metrics().provenance.recording.dataset
    return dataset is not None and output.resolve().is_relative_to(Path(dataset).resolve())
