"""Imports of third-party libraries that need preparation."""

import ctypes
import functools
import importlib
from contextlib import suppress
from threading import Thread
from types import ModuleType

from slam.errors import DownloadError, SequenceError, SlamError


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


def import_rerun() -> ModuleType:
    """Import the rerun SDK, an optional extra.

    Raises:
        SlamError: if it is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("rerun")
    except (ImportError, OSError) as error:
        raise SlamError(f"--rerun needs rerun ({error}): pip install 'erfsfm-slam[rerun]', or rerun-sdk") from error


def import_onnx() -> tuple[ModuleType, ModuleType]:
    """Import onnx and ONNX Runtime, an optional extra.

    Raises:
        SlamError: if one is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("onnx"), importlib.import_module("onnxruntime")
    except (ImportError, OSError) as error:
        raise SlamError(
            f"depth.source=onnx needs onnx and onnxruntime ({error}): pip install 'erfsfm-slam[onnx]'"
        ) from error


def import_laspy() -> ModuleType:
    """Import laspy with its LAZ codec, an optional extra.

    Raises:
        SlamError: if one is not installed or cannot be loaded.
    """
    try:
        importlib.import_module("lazrs")
        return importlib.import_module("laspy")
    except (ImportError, OSError) as error:
        raise SlamError(f"LAS and LAZ need laspy and lazrs ({error}): pip install 'erfsfm-slam[las]'") from error


def import_rasterio() -> ModuleType:
    """Import rasterio, an optional extra.

    Raises:
        SlamError: if it is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("rasterio")
    except (ImportError, OSError) as error:
        raise SlamError(f"GeoTIFF needs rasterio ({error}): pip install 'erfsfm-slam[geotiff]'") from error


def import_rosbags() -> tuple[ModuleType, ModuleType, ModuleType]:
    """Import the readers of ROS 1 and ROS 2 bags and the message types of rosbags, an optional extra.

    Raises:
        SequenceError: if it is not installed or cannot be loaded.
    """
    try:
        rosbag1, rosbag2, typesys = (
            importlib.import_module(f"rosbags.{name}") for name in ("rosbag1", "rosbag2", "typesys")
        )
    except (ImportError, OSError) as error:
        raise SequenceError(f"bags need rosbags ({error}): pip install 'erfsfm-slam[ros]'") from error
    return rosbag1, rosbag2, typesys


def import_feather() -> ModuleType:
    """Import pyarrow's reader of feather files, an optional extra.

    Raises:
        SequenceError: if it is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("pyarrow.feather")
    except (ImportError, OSError) as error:
        raise SequenceError(f"Argoverse 2 needs pyarrow ({error}): pip install 'erfsfm-slam[argoverse]'") from error


def import_zmq() -> ModuleType:
    """Import pyzmq, an optional extra.

    Raises:
        SlamError: if it is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("zmq")
    except (ImportError, OSError) as error:
        raise SlamError(f"--publish needs pyzmq ({error}): pip install 'erfsfm-slam[live]'") from error


def import_dask() -> tuple[ModuleType, ModuleType]:
    """Import cloudpickle and Dask's distributed scheduler, an optional extra.

    Raises:
        SlamError: if one is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("cloudpickle"), importlib.import_module("distributed")
    except (ImportError, OSError) as error:
        raise SlamError(
            f"several workers and schedulers need Dask ({error}): pip install 'erfsfm-slam[cluster]'"
        ) from error


def import_remotezip() -> tuple[ModuleType, ModuleType, ModuleType]:
    """Import remotezip, requests and the exceptions of urllib3 below them, an optional extra.

    Raises:
        DownloadError: if one is not installed or cannot be loaded.
    """
    try:
        names = ("remotezip", "requests", "urllib3.exceptions")
        remotezip, requests, exceptions = (importlib.import_module(name) for name in names)
    except (ImportError, OSError) as error:
        raise DownloadError(
            f"download needs remotezip and requests ({error}): pip install 'erfsfm-slam[download]'"
        ) from error
    return remotezip, requests, exceptions


def import_open3d_beside() -> None:
    """Import Open3D, which takes a second, in another thread; errors are raised by the next `import_open3d`."""

    def begin() -> None:
        with suppress(SlamError):
            import_open3d()

    Thread(target=begin, name="open3d").start()
