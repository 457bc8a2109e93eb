"""Work that the threads of a pass have not finished yet."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from slam.frames import DepthMap, Frame, SnippetPoses


@dataclass(frozen=True)
class PendingFrame:
    """A frame submitted to the networks, whose other measurements are pending; None is not asked for."""

    frame: Frame
    depth: Future[DepthMap] | None
    snippet: Future[SnippetPoses] | None


@dataclass(frozen=True)
class PendingTask:
    """A task of another thread, the stage that waits for it, and what to do with its ``result``."""

    stage: str
    result: Future[Any]
    keep: Callable[[Any], None]
