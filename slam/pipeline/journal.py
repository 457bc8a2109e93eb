"""The state of a pass over the frames, kept on disk while the pass goes on.

Each part holds what was measured since the one before; beside the last part lies the state of the front end. A killed
run goes on from there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from slam.errors import RunError, SlamError
from slam.frontend.drive import Drive
from slam.pipeline.checkpoint import SERIALISER, SessionCheckpoint, read_keyframes, write_keyframes
from slam.pipeline.observer import FrontEndState
from slam.storage.files import JOURNAL_FILE, write_atomically

logger = logging.getLogger(__name__)

EVERY_FRAMES = 100
# maps of keyframes, rewritten whole with each state, grow with the drive: so must the distance between states
_GROWTH = 0.1


class Journal:
    """Keeps the states of one pass; after a failure (a full disk) it warns, keeps no more, and the run goes on."""

    def __init__(
        self, folder: Path, checkpoint_of: Callable[[FrontEndState], SessionCheckpoint], with_keyframes: bool
    ) -> None:
        """Prepare for the first state.

        Args:
            folder: of the run.
            checkpoint_of: the checkpoint of a state.
            with_keyframes: also keep the frames of the map.
        """
        self._folder = folder
        self._checkpoint_of = checkpoint_of
        self._with_keyframes = with_keyframes
        self._counts: dict[str, int] = {}
        self._is_writable = True

    def begin_after(self, drive: Drive) -> None:
        """Take what was measured by an earlier process, whose journal is in the same folder, as kept."""
        self._counts = {name: len(items) for name, items in drive.collected().items()}

    def keep(self, state: FrontEndState) -> None:
        """Write what is new since the last state, then the state of the front end; maps, at distances that grow."""
        frames, items, before = len(state.drive), state.drive.collected(), self._counts.get("roads", 0)
        is_early = state.keyframes is not None and frames - before < _GROWTH * before
        if is_early or not self._is_writable:
            return
        new = Drive(**{name: _after(each, self._counts.get(name, 0)) for name, each in items.items()})
        whole = replace(self._checkpoint_of(state), reference=None, state=replace(state, drive=Drive()))
        measured = replace(new, keyframes=[], examples=[])
        try:
            self._write(f"pass-part-{frames:06d}.zip", lambda path: SERIALISER.write(path, measured))
            if self._with_keyframes:
                self._write(f"pass-keyframes-{frames:06d}.npz", lambda path: write_keyframes(path, new.keyframes))
            self._write(f"pass-state-{frames:06d}.zip", whole.write)
            _remove(self._folder, "state", frames)
        except (SlamError, OSError) as error:
            logger.warning("the state of the run is not kept any more, a killed run goes on from before: %s", error)
            self._is_writable = False
        self.begin_after(state.drive)

    def _write(self, name: str, fill: Callable[[Path], object]) -> None:
        write_atomically(self._folder / name, fill)


def read_journal(folder: Path) -> SessionCheckpoint | None:
    """The last whole state of a killed pass, with its keyframes where they were kept; None where there is none.

    Its stamps are those of the whole sequence.

    Raises:
        RunError: a file is damaged or missing.
    """
    states = _files(folder, "state")
    if not states:
        return None
    last = max(states)
    checkpoint, drive = SessionCheckpoint.read(states[last]), Drive()
    keyframes = _files(folder, "keyframes")
    for frames, path in sorted(_files(folder, "part").items()):
        if frames > last:
            break
        part = SERIALISER.read(path)
        if not isinstance(part, Drive):
            raise RunError(f"{path} is damaged: run the sequence again")
        _extend(drive, part)
        if frames in keyframes:
            drive.keyframes.extend(read_keyframes(keyframes[frames]))
    if len(drive) != last:
        raise RunError(
            f"{folder} lacks parts of what its run kept ({len(drive)} of {last} frames are there): "
            "run the sequence again"
        )
    return replace(checkpoint, state=replace(checkpoint.state, drive=drive))


def clear_journal(folder: Path) -> None:
    """Remove the journal of a pass that is whole."""
    for kind in ("state", "part", "keyframes"):
        _remove(folder, kind)


def _files(folder: Path, kind: str) -> dict[int, Path]:
    """The files of a kind by the frames that were done."""
    matches = ((JOURNAL_FILE.fullmatch(path.name), path) for path in folder.iterdir())
    return {int(match["frames"]): path for match, path in matches if match and match["kind"] == kind}


def _remove(folder: Path, kind: str, before: int | None = None) -> None:
    for frames, path in _files(folder, kind).items():
        if before is None or frames < before:
            path.unlink(missing_ok=True)


def _after(items: Any, count: int) -> Any:
    return dict(islice(items.items(), count, None)) if isinstance(items, dict) else items[count:]


def _extend(drive: Drive, part: Drive) -> None:
    new = part.collected()
    for name, items in drive.collected().items():
        if isinstance(items, dict):
            items.update(new[name])
        else:
            items.extend(new[name])
