"""The inputs of a live run, which are the options of the verb ``live``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class LiveRequest:
    """All inputs of a live run, as ``erfsfm-slam live --help`` says; ``command`` is recorded in the metrics."""

    dataset: str
    camera: Path | None = None
    every_frame: bool = False
    output: Path | None = None
    view: bool = False
    wait: float = 10.0
    weights: str = "default"
    config: str | None = None
    overrides: list[str] | None = None
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    command: str = "slam.commands.live.run.run_live"
