"""The parts of a run that can be exported: the options each takes, and what it may replace."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from slam.commands.exports.nerfstudio import POINTS
from slam.commands.exports.options import R_UP_WORLDS, ExportOptions
from slam.commands.exports.raster import RASTER_FILES, is_own_raster
from slam.formats.colmap import BINARY_FOLDER, MODEL_FILES, is_own_model
from slam.formats.ros_map import describes_map
from slam.formats.transforms import TRANSFORMS, is_own_scene
from slam.results.folder import RunFolder
from slam.results.output_file import check_replaced, check_replaced_trajectory
from slam.runtime.errors import RunError
from slam.runtime.run_files import CONFIG
from slam.runtime.storage.record import known

_MIN_TRIANGLES = 4


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
        options: fields of `ExportOptions` that have an effect.
        beginnings: of a file: the ends that its name may have, and how such a file begins.
        folder: of several files.
        up: the only axes besides those of the run, where it cannot have all.
    """

    options: tuple[str, ...] = ()
    beginnings: Mapping[str, bytes] = field(default_factory=dict)
    folder: FolderPart | None = None
    up: str = ""


PARTS = {
    "mesh": Part(("crop", "voxel", "triangles"), {".ply": b"ply", ".glb": b"glTF", ".gltf": b"{"}),
    "cloud": Part(("crop", "voxel"), {".ply": b"ply", ".las": b"LASF", ".laz": b"LASF"}),
    "trajectory": Part(),
    "graph": Part((), {".g2o": b"VERTEX_SE3", ".txt": b"VERTEX_SE3"}, up="y-down"),
    "colmap": Part(
        ("crop", "voxel", "dataset", "points"),
        folder=FolderPart("a COLMAP model", ("images", BINARY_FOLDER, *MODEL_FILES), is_own_model),
    ),
    "nerfstudio": Part(
        ("crop", "voxel", "dataset"), folder=FolderPart("a scene", ("images", POINTS, TRANSFORMS), is_own_scene)
    ),
    "raster": Part(
        ("crop", "resolution", "origin"), folder=FolderPart("a raster", RASTER_FILES, is_own_raster), up="z"
    ),
    "occupancy": Part(("crop", "resolution"), {".yaml": b"", ".pgm": b"P5"}, up="z"),
}


def check_options(what: str, up: str, options: ExportOptions) -> None:
    """Refuse what does not exist, has no effect or makes no sense.

    Raises:
        RunError: one line.
    """
    if what not in PARTS:
        raise RunError(f"--what {what!r} is unknown: choose one of {', '.join(PARTS)}")
    if up not in R_UP_WORLDS:
        raise RunError(f"--up {up!r} is unknown: choose {', '.join([*R_UP_WORLDS][:-1])} or {[*R_UP_WORLDS][-1]}")
    for name in (each.name for each in fields(options)):
        if getattr(options, name) is not None and name not in PARTS[what].options:
            takers = ", ".join(taker for taker, part in PARTS.items() if name in part.options)
            raise RunError(f"--{name} does nothing for {what}: it is for {takers}")
    for name in ("voxel", "resolution"):
        value = getattr(options, name)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise RunError(f"--{name} {value} must be a positive length")
    if options.points is not None and options.points < 1:
        raise RunError(f"--points {options.points} is too few: give 1 or more")
    if options.triangles is not None and options.triangles < _MIN_TRIANGLES:
        raise RunError(f"--triangles {options.triangles} is too few: give {_MIN_TRIANGLES} or more")
    only = PARTS[what].up
    if only and up not in ("y-down", only):
        raise RunError(f"{what} has axes of its own: leave --up out or give --up {only}")


def check_target(folder: RunFolder, what: str, output: Path) -> None:
    """Check an ``output`` before anything is computed.

    Raises:
        RunError: it is a folder where a file is wanted or the reverse, a file of a run or of the run's recording, or
            what would be replaced is something else.
    """
    part, files = PARTS[what], [output]
    if part.folder is not None:
        if output.exists() and not output.is_dir():
            raise RunError(f"{output} is a file: {part.folder.noun} is several files, give the name of a folder")
        others = [name for name in part.folder.names if (output / name).exists()]
        if others and not part.folder.is_own(output):
            raise RunError(f"{output / others[0]} is none of ours and would be replaced: choose another --output")
        return
    if what == "trajectory":
        check_replaced_trajectory(output)
    else:
        check_replaced(output, part.beginnings)
    if what == "occupancy" and output.suffix.lower() in part.beginnings:
        files = [output.with_suffix(suffix) for suffix in part.beginnings]
        present = [path for path in files if path.exists() and path.stat().st_size]
        if present and not describes_map(files[0]):
            raise RunError(f"{present[0]} exists and is no map of ROS: choose another --output")
        for path in files:
            check_replaced(path, part.beginnings)
    for path in files:
        if path.is_file() and _is_in_recording(folder, path):
            raise RunError(f"{path} belongs to the recording of the run: choose another --output")


def _is_in_recording(folder: RunFolder, output: Path) -> bool:
    """Whether a file lies in the folder that was run, and was there before the run."""
    began = folder.path / CONFIG
    if not began.is_file() or output.stat().st_mtime > began.stat().st_mtime:
        return False
    dataset = known(folder.metrics().provenance.recording.dataset)
    return dataset is not None and output.resolve().is_relative_to(Path(dataset).resolve())
