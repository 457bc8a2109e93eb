"""Where a part of a run may be written: never over the run itself, nor over a file of another kind."""

from __future__ import annotations

from pathlib import Path

from slam.errors import RunError
from slam.exports.raster import RASTER
from slam.formats.colmap import MODEL_FILES, is_own_model
from slam.formats.ros_map import describes_map
from slam.formats.transforms import TRANSFORMS, is_own_scene
from slam.results.folder import RunFolder
from slam.results.output import is_own

_FOLDERS = {"colmap": "a COLMAP model", "nerfstudio": "a scene", "raster": "a raster"}
_NAMES = {
    "colmap": MODEL_FILES,
    "nerfstudio": ("images", TRANSFORMS),
    "raster": ("height.png", "colour.png"),
}
_OURS = {"colmap": is_own_model, "nerfstudio": is_own_scene, "raster": lambda output: (output / RASTER).is_file()}
_TEXTS = {"trajectory": (".txt", ".tum", ".kitti"), "graph": (".g2o", ".txt")}


def check_target(folder: RunFolder, what: str, output: Path) -> None:
    """Check an ``output`` before anything is computed.

    Raises:
        RunError: it is a folder where a file is wanted or the reverse, a file of the run itself, or what would be
            replaced is something else.
    """
    if what in _FOLDERS:
        if output.exists() and not output.is_dir():
            raise RunError(f"{output} is a file: {_FOLDERS[what]} is several files, give the name of a folder")
        others = [name for name in _NAMES[what] if (output / name).exists()]
        if others and not _OURS[what](output):
            raise RunError(f"{output / others[0]} is none of ours and would be replaced: choose another --output")
        return
    if output.is_dir():
        raise RunError(f"{output} is a folder: give the name of a file to write")
    if is_own(output.name) and output.resolve().parent == folder.path.resolve():
        raise RunError(f"{output} is a file of the run itself: choose another --output")
    if not output.is_file():
        return
    suffixes = _TEXTS.get(what, (output.suffix,))
    if output.suffix.lower() not in suffixes:
        raise RunError(f"{output} exists and does not end in {' or '.join(suffixes)}: choose another --output")
    if what == "occupancy" and output.suffix.lower() == ".yaml" and not describes_map(output):
        raise RunError(f"{output} exists and is no map of ROS: choose another --output")
