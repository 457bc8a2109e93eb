"""Imports of third-party libraries that need preparation."""

import ctypes
import functools
import importlib
import sys
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points
from threading import Thread
from types import ModuleType
from typing import Any

from slam.runtime.errors import SlamError

# of each optional extra: what needs it, and its modules
EXTRAS: dict[str, tuple[str, tuple[str, ...]]] = {
    "cluster": ("several workers and schedulers need Dask", ("distributed",)),
    "download": (
        "download needs remotezip and requests",
        ("remotezip", "requests", "urllib3.exceptions"),
    ),
    "rerun": ("--rerun and --view need rerun", ("rerun",)),
    "ros": ("bags need rosbags", ("rosbags.rosbag1", "rosbags.rosbag2", "rosbags.typesys")),
}

_WINDOWS = "open3d.visualization"


@functools.cache
def import_open3d() -> ModuleType:
    """Import Open3D, loading the libusb that its wheels link but do not ship.

    Raises:
        SlamError: it, or the libusb that it needs, cannot be loaded.
    """
    try:
        libusb_package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        return _without_windows()
    except (ImportError, OSError) as error:
        raise SlamError(
            f"Open3D cannot be loaded ({error}); install open3d-cpu and libusb-package"
        ) from error


def _without_windows() -> ModuleType:
    """Open3D, whose windows are imported where they are first used: their Dash and IPython are half of its time.

    In a notebook it comes whole, for it then prepares windows there at once.
    """
    if "open3d" in sys.modules or "ipykernel" in sys.modules:
        return importlib.import_module("open3d")
    sys.modules[_WINDOWS] = ModuleType(_WINDOWS)
    try:
        open3d = importlib.import_module("open3d")
    finally:
        sys.modules.pop(_WINDOWS, None)

    def first_used(name: str) -> ModuleType:
        if name != "visualization":
            raise AttributeError(f"module 'open3d' has no attribute '{name}'")
        return importlib.import_module(_WINDOWS)

    vars(open3d)["__getattr__"] = first_used
    return open3d


def import_extra(extra: str) -> tuple[ModuleType, ...]:
    """Import the modules of an optional extra of the package, in the order of `EXTRAS`.

    Raises:
        SlamError: the extra is not installed; the message says how to install it.
    """
    needs, modules = EXTRAS[extra]
    try:
        return tuple(importlib.import_module(name) for name in modules)
    except (ImportError, OSError) as error:
        raise SlamError(f"{needs} ({error}): pip install 'erfsfm-slam[{extra}]'") from error


@functools.cache
def plug_ins(group: str) -> dict[str, EntryPoint]:
    """What other packages offer as entry points of a group, by name."""
    return {point.name: point for point in entry_points(group=group)}


def import_plug_in(point: EntryPoint) -> Any:
    """What an entry point names.

    Raises:
        SlamError: it cannot be loaded; the message names its package.
    """
    try:
        return point.load()
    except (ImportError, AttributeError, OSError) as error:
        package = "another package" if point.dist is None else point.dist.name
        raise SlamError(
            f"{point.name} of {package} cannot be loaded ({error}): repair or uninstall it"
        ) from error


def import_open3d_beside() -> None:
    """Import Open3D, which takes a second, in another thread; errors are raised by the next `import_open3d`."""

    def begin() -> None:
        with suppress(SlamError):
            import_open3d()

    Thread(target=begin, name="open3d").start()
