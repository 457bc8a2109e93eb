"""Monocular SLAM on learned depth and ego-motion: from frames to trajectory and map."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from erfsfm import DISTRIBUTION as DISTRIBUTION

if TYPE_CHECKING:
    from slam.commands.run import run_slam
    from slam.config.sections import load_config
    from slam.pipeline.live import Slam
    from slam.results.folder import RunFolder

__all__ = ["RunFolder", "Slam", "load_config", "run_slam"]
_HOMES = {
    "RunFolder": "slam.results.folder",
    "Slam": "slam.pipeline.live",
    "load_config": "slam.config.sections",
    "run_slam": "slam.commands.run",
}


def __getattr__(name: str) -> Any:
    """Import the system on first use: ``import slam`` alone stays light."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'slam' has no attribute '{name}': it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
