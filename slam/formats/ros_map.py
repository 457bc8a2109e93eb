"""Occupancy grids as ROS' map_server reads them: a PGM image and a YAML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from erfsfm.common.files import read_text
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
_OCCUPIED_THRESH, _FREE_THRESH = 0.65, 0.196


def describes_map(path: Path) -> bool:
    """Whether a YAML file is the description of such a map."""
    try:
        return "occupied_thresh:" in read_text(path)
    except (OSError, UnicodeDecodeError):
        return False


def write_ros_map(
    path: Path, cells: NDArray[np.uint8], corner: tuple[float, float], resolution: float, unit: str
) -> None:
    """Write ``<name>.pgm`` and, after it, ``<name>.yaml``, each atomically.

    Args:
        path: the YAML file.
        cells: ``(H, W)`` of `FREE`, `OCCUPIED` and `UNKNOWN`; the first row has the largest y.
        corner: x and y of the outer corner at the bottom left.
        resolution: side of a cell.
        unit: of lengths, which ``map_server`` takes for metres: a comment says so.

    Raises:
        RunError: a file cannot be written.
    """
    height, width = cells.shape
    image = path.with_suffix(".pgm")
    content = f"P5\n{width} {height}\n255\n".encode("ascii") + np.ascontiguousarray(cells).tobytes()
    write_atomically(image, lambda partial: partial.write_bytes(content), RunError)
    description = {
        "image": image.name,
        "resolution": resolution,
        "origin": [*corner, 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESH,
        "free_thresh": _FREE_THRESH,
    }
    text = f"# lengths in {unit}\n" + yaml.safe_dump(description, sort_keys=False, default_flow_style=None)
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"), RunError)
