"""Where a part of a run may be written: never over a run or its recording, nor over a file of another kind."""

from __future__ import annotations

from pathlib import Path

from slam.commands.exports.nerfstudio import POINTS
from slam.commands.exports.raster import RASTER_FILES, is_own_raster
from slam.formats.colmap import MODEL_FILES, is_own_model
from slam.formats.ros_map import describes_map
from slam.formats.transforms import TRANSFORMS, is_own_scene
from slam.results.folder import RunFolder
from slam.results.output_file import check_replaced, check_replaced_trajectory
from slam.runtime.errors import RunError
from slam.runtime.run_files import CONFIG
from slam.runtime.storage.record import known

_FOLDERS = {"colmap": "a COLMAP model", "nerfstudio": "a scene", "raster": "a raster"}
_NAMES = {
    "colmap": MODEL_FILES,
    "nerfstudio": ("images", POINTS, TRANSFORMS),
    "raster": RASTER_FILES,
}
_OURS = {"colmap": is_own_model, "nerfstudio": is_own_scene, "raster": is_own_raster}
_BEGINNINGS = {
    "mesh": {".ply": b"ply", ".glb": b"glTF", ".gltf": b"{"},
    "cloud": {".ply": b"ply", ".las": b"LASF", ".laz": b"LASF"},
    "graph": {".g2o": b"VERTEX_SE3", ".txt": b"VERTEX_SE3"},
    "occupancy": {".yaml": b"", ".pgm": b"P5"},
}


def check_target(folder: RunFolder, what: str, output: Path) -> None:
    """Check an ``output`` before anything is computed.

    Raises:
        RunError: it is a folder where a file is wanted or the reverse, a file of a run or of the run's recording, or
            what would be replaced is something else.
    """
    if what in _FOLDERS:
        if output.exists() and not output.is_dir():
            raise RunError(f"{output} is a file: {_FOLDERS[what]} is several files, give the name of a folder")
        others = [name for name in _NAMES[what] if (output / name).exists()]
        if others and not _OURS[what](output):
            raise RunError(f"{output / others[0]} is none of ours and would be replaced: choose another --output")
        return
    files = [output]
    if what == "trajectory":
        check_replaced_trajectory(output)
    else:
        check_replaced(output, _BEGINNINGS[what])
    if what == "occupancy" and output.suffix.lower() in _BEGINNINGS[what]:
        files = [output.with_suffix(suffix) for suffix in _BEGINNINGS[what]]
        present = [path for path in files if path.exists() and path.stat().st_size]
        if present and not describes_map(files[0]):
            raise RunError(f"{present[0]} exists and is no map of ROS: choose another --output")
        for path in files:
            check_replaced(path, _BEGINNINGS[what])
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
