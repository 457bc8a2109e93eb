"""A kind of recording in the catalogue: how it is recognised, and how its sequences are opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slam.sequences.recording import RecordedSequence

Opener = Callable[[], RecordedSequence]


@dataclass(frozen=True)
class Asked:
    """Options of the user beside the data set.

    Attributes:
        name: of a sequence, or None for the only one.
        camera: a ``camera.yaml`` in place of the recording's own calibration, or ``fov=DEGREES`` (`camera_file`).
    """

    name: str | None = None
    camera: Path | None = None


@dataclass(frozen=True)
class Loader:
    """One kind of recording; `slam.sequences.catalogue.LOADERS` lists all.

    Attributes:
        kind: what ``doctor`` calls it.
        layout: the files by which it is recognised, for the message about a folder of no known kind.
        find: the sequences under a path by name, and how to open each; empty where the path is of another kind. It
            reads no images.
    """

    kind: str
    layout: str
    find: Callable[[Path, Asked], dict[str, Opener]]
