"""Rasters as GeoTIFF, through rasterio (an optional extra)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import RunError
from slam.runtime.imports import import_extra
from slam.runtime.storage.files import write_atomically


def local_projection(latitude_deg: float, longitude_deg: float) -> str:
    """PROJ text of the azimuthal equidistant projection in metres about a place (WGS 84)."""
    place = f"+lat_0={latitude_deg!r} +lon_0={longitude_deg!r}"
    return f"+proj=aeqd {place} +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"


def write_geotiff(
    path: Path,
    bands: NDArray[Any],
    corner: tuple[float, float],
    resolution: float,
    crs: str,
    known: NDArray[np.bool_] | None = None,
) -> None:
    """Write a raster, atomically, north up.

    Args:
        path: the file.
        bands: ``(B, H, W)``; floats are NaN where unknown.
        corner: east and north of the outer corner at the top left.
        resolution: side of a pixel, metres.
        crs: PROJ text.
        known: pixels ``(H, W)`` with a value, written as the mask of the file.

    Raises:
        SlamError: rasterio is not installed, or (`RunError`) the file cannot be written.
    """
    (rasterio,) = import_extra("geotiff")
    count, height, width = bands.shape
    is_height = np.issubdtype(bands.dtype, np.floating)
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": count,
        "dtype": bands.dtype.name,
        "crs": rasterio.crs.CRS.from_string(crs),
        "transform": rasterio.transform.from_origin(*corner, resolution, resolution),
        "compress": "deflate",
        "tiled": True,
    }
    profile |= {"nodata": float("nan")} if is_height else {"photometric": "RGB"}

    # through memory: GDAL only logs what it cannot write as it closes a file; the mask belongs into the file
    with rasterio.io.MemoryFile() as memory, rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        with memory.open(**profile) as file:
            file.write(bands)
            if known is not None:
                file.write_mask(known)
        content = memory.read()
    write_atomically(path, lambda partial: partial.write_bytes(content), RunError)
