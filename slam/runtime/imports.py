"""Imports of third-party libraries that need preparation."""

import ctypes
import functools
import importlib
from contextlib import suppress
from threading import Thread
from types import ModuleType

from slam.runtime.errors import DownloadError, SequenceError, SlamError


@functools.cache
def import_open3d() -> ModuleType:
    """Import Open3D, loading the libusb that its wheels link but do not ship.

    Raises:
        SlamError: if Open3D or libusb-package is not installed or cannot be loaded.
    """
    try:
        libusb_package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise SlamError(f"Open3D cannot be loaded ({error}); install open3d-cpu and libusb-package") from error


def import_rerun(option: str) -> ModuleType:
    """Import the rerun SDK, an optional extra that ``option`` needs; `SlamError` if it cannot be loaded."""
    (rerun,) = _import_extra(f"{option} needs rerun", "'erfsfm-slam[rerun]', or rerun-sdk", "rerun")
    return rerun


def import_laspy() -> ModuleType:
    """Import laspy with its LAZ codec, an optional extra; `SlamError` if one cannot be loaded."""
    _, laspy = _import_extra("LAS and LAZ need laspy and lazrs", "'erfsfm-slam[las]'", "lazrs", "laspy")
    return laspy


def import_rasterio() -> ModuleType:
    """Import rasterio, an optional extra; `SlamError` if it cannot be loaded."""
    (rasterio,) = _import_extra("GeoTIFF needs rasterio", "'erfsfm-slam[geotiff]'", "rasterio")
    return rasterio


def import_rosbags() -> tuple[ModuleType, ...]:
    """Import the readers of ROS 1 and ROS 2 bags and the message types of rosbags, an optional extra.

    Raises:
        SequenceError: if it is not installed or cannot be loaded.
    """
    names = ("rosbags.rosbag1", "rosbags.rosbag2", "rosbags.typesys")
    return _import_extra("bags need rosbags", "'erfsfm-slam[ros]'", *names, error_type=SequenceError)


def import_feather() -> ModuleType:
    """Import pyarrow's reader of feather files, an optional extra; `SequenceError` if it cannot be loaded."""
    (feather,) = _import_extra(
        "Argoverse 2 needs pyarrow", "'erfsfm-slam[argoverse]'", "pyarrow.feather", error_type=SequenceError
    )
    return feather


def import_zmq() -> ModuleType:
    """Import pyzmq, an optional extra; `SlamError` if it cannot be loaded."""
    (zmq,) = _import_extra("--publish needs pyzmq", "'erfsfm-slam[live]'", "zmq")
    return zmq


def import_dask() -> tuple[ModuleType, ...]:
    """Import cloudpickle and Dask's distributed scheduler, an optional extra; `SlamError` if one cannot be loaded."""
    return _import_extra(
        "several workers and schedulers need Dask", "'erfsfm-slam[cluster]'", "cloudpickle", "distributed"
    )


def import_remotezip() -> tuple[ModuleType, ...]:
    """Import remotezip, requests and the exceptions of urllib3 below them, an optional extra.

    Raises:
        DownloadError: if one is not installed or cannot be loaded.
    """
    names = ("remotezip", "requests", "urllib3.exceptions")
    needs = "download needs remotezip and requests"
    return _import_extra(needs, "'erfsfm-slam[download]'", *names, error_type=DownloadError)


def _import_extra(
    needs: str, install: str, *names: str, error_type: type[Exception] = SlamError
) -> tuple[ModuleType, ...]:
    """Import modules of an optional extra; if one cannot be loaded, say what needs them and what to install."""
    try:
        return tuple(importlib.import_module(name) for name in names)
    except (ImportError, OSError) as error:
        raise error_type(f"{needs} ({error}): pip install {install}") from error


def import_open3d_beside() -> None:
    """Import Open3D, which takes a second, in another thread; errors are raised by the next `import_open3d`."""

    def begin() -> None:
        with suppress(SlamError):
            import_open3d()

    Thread(target=begin, name="open3d").start()
