"""Monocular SLAM on learned depth and ego-motion: from frames to trajectory and map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from erfsfm import DISTRIBUTION as DISTRIBUTION

if TYPE_CHECKING:
    from slam.commands.run.run import run_slam
    from slam.pipeline.live import Slam
    from slam.results.folder import RunFolder

__all__ = ["RunFolder", "Slam", "run_slam"]


def __getattr__(name: str) -> Any:
    """Import the system on first use: ``import slam`` alone stays light."""
    if name == "Slam":
        from slam.pipeline.live import Slam

        return Slam
    if name == "RunFolder":
        from slam.results.folder import RunFolder

        return RunFolder
    if name == "run_slam":
        from slam.commands.run.run import run_slam

        return run_slam
    raise AttributeError(f"module 'slam' has no attribute '{name}'")
