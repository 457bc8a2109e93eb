"""Clouds as LAS or LAZ, through laspy (an optional extra)."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from slam.formats.ply import Ply
from slam.runtime.errors import RunError
from slam.runtime.imports import import_extra
from slam.runtime.storage.files import write_atomically

_STEP = 1e-4  # coordinates are integers of this unit: 214 km to either side
_RGB_POINTS = 2  # the point format with colours and without time
_TO_16_BITS = 257  # 255 becomes 65535


def write_las(path: Path, cloud: Ply) -> None:
    """Write points and colours (LAS 1.2, point format 2), atomically; compressed where the name ends in ``.laz``.

    Raises:
        SlamError: laspy is not installed, or (`RunError`) the file cannot be written.
    """
    _, laspy = import_extra("las")
    points, colours = cloud.points, cloud.colours_or_grey
    header = laspy.LasHeader(point_format=_RGB_POINTS, version="1.2")
    header.scales = np.full(3, _STEP)
    header.offsets = np.floor(points.min(axis=0))
    header.generating_software = "erfsfm-slam"
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = colours.astype(np.uint16).T * np.uint16(_TO_16_BITS)
    # through memory: errors of a full disk come from the codec as an exception of its own
    content = io.BytesIO()
    las.write(content, do_compress=path.suffix.lower() == ".laz")
    write_atomically(path, lambda partial: partial.write_bytes(content.getbuffer()), RunError)
