"""The drives of a batch: from a manifest in CSV, or all sequences of a data set."""

from __future__ import annotations

import csv
import io
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from erfsfm.common.files import read_text
from erfsfm.common.readers.frame_range import EVERYTHING
from erfsfm.inference import record_of_whole_weights
from slam.config.sections import load_config
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import sequence_names
from slam.sequences.excerpt import frame_range

MANIFEST = ".csv"
_KEYS = ("name", "dataset", "sequence", "camera", "options")
_OURS = ("--dataset", "--sequence", "-s", "--camera", "--output", "--json")


@dataclass(frozen=True)
class Drive:
    """One run: ``name`` of its folder, and ``arguments`` of ``erfsfm-slam run`` without ``--output``.

    Relative paths are seen from ``folder``.
    """

    name: str
    folder: Path
    arguments: tuple[str, ...]


def drives_of(manifest_or_root: Path, sequences: Sequence[str], options: Sequence[str]) -> list[Drive]:
    """The drives of a manifest, or the named sequences of a data set.

    Args:
        manifest_or_root: a ``.csv`` file, or a data set.
        sequences: names in the data set; ``all`` is every one.
        options: of ``run``, for all drives; those of a manifest come after them.

    Raises:
        SequenceError: no such file or sequences, or an entry that is not understood.
    """
    if manifest_or_root.suffix.lower() == MANIFEST and manifest_or_root.is_file():
        if list(sequences) != ["all"]:
            raise SequenceError(f"{manifest_or_root} names its sequences itself: leave out --sequence")
        return _manifest(manifest_or_root, options)
    if manifest_or_root.suffix.lower() == MANIFEST and not manifest_or_root.exists():
        raise SequenceError(f"no manifest {manifest_or_root}: check the path")
    known = sequence_names(manifest_or_root)
    if not known:
        raise SequenceError(f"{manifest_or_root} is no manifest ({MANIFEST}) and holds no sequences")
    missing = [name for name in sequences if name != "all" and name not in known]
    if missing:
        raise SequenceError(f"{manifest_or_root} has no sequence {missing[0]}: it has {', '.join(known)}")
    chosen = known if "all" in sequences else sequences
    # KITTI may be named by the environment alone
    root = manifest_or_root.absolute() if manifest_or_root.exists() else manifest_or_root
    drives = [
        Drive(name, root.absolute().parent, ("--dataset", str(root), "--sequence", name, *options)) for name in chosen
    ]
    return _named([("", drive) for drive in drives], root)


def _manifest(path: Path, options: Sequence[str]) -> list[Drive]:
    try:
        rows = _rows(path)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SequenceError(f"the manifest {path} cannot be read: {getattr(error, 'strerror', error)}") from error
    if not rows:
        raise SequenceError(f"{path} names no drive: give rows of {', '.join(_KEYS)}")
    return _named(
        [
            (row.get("name", ""), _drive(row, path, f"{path}, drive {number}", options))
            for number, row in enumerate(rows, start=1)
        ],
        path,
    )


def _rows(path: Path) -> list[dict[str, str]]:
    lines = io.StringIO(read_text(path), newline="")
    return [{key: word for key, word in row.items() if word} for row in csv.DictReader(lines, skipinitialspace=True)]


def _drive(row: dict[str, str], path: Path, where: str, options: Sequence[str]) -> Drive:
    unknown = [str(key) for key in row if key not in _KEYS]
    if unknown or "dataset" not in row:
        problem = f"{unknown[0]!r} is no key" if unknown else "dataset is missing"
        raise SequenceError(f"{where}: {problem}; the keys are {', '.join(_KEYS)}")
    try:
        own = shlex.split(row.get("options", ""))
    except ValueError as error:
        raise SequenceError(
            f"{where}: options are not understood ({error}): write them as on a command line"
        ) from error
    taken = [word for word in own if word.partition("=")[0] in _OURS]
    if taken:
        raise SequenceError(
            f"{where}: {taken[0]} is no option of a drive: use the keys, the folder is given by the batch"
        )
    named = [word for key in ("dataset", "sequence", "camera") if key in row for word in (f"--{key}", row[key])]
    name = row.get("name") or row.get("sequence") or Path(row["dataset"]).stem
    return Drive(name, path.absolute().parent, (*named, *options, *own))


def require_known(drive: Drive) -> None:
    """Check what can be wrong in the options of a drive whatever its recording holds.

    Raises:
        SlamError, ErfsfmError: one line.
    """
    given: dict[str, list[str]] = {}
    for word, following in zip(drive.arguments, (*drive.arguments[1:], "")):
        option, equals, value = word.partition("=")
        given.setdefault(option, []).append(value if equals else following)

    def last(option: str, default: str | None = None) -> str | None:
        value = given.get(option, [default])[-1]
        return str(drive.folder / value) if value and (drive.folder / value).exists() else value

    load_config(last("--config"), given.get("--set", ()))
    if (frames := last("--frames")) is not None:
        frame_range(frames, EVERYTHING)
    record_of_whole_weights(last("--weights", "default") or "")


def _named(drives: Iterable[tuple[str, Drive]], path: Path) -> list[Drive]:
    """Drives with names for folders; a repeated name is numbered, unless the manifest at ``path`` gave it."""
    found: dict[str, Drive] = {}
    for given, drive in drives:
        name = re.sub(r"[^\w.-]+", "-", drive.name).strip("-.") or "drive"
        if given and name in found:
            raise SequenceError(f"{path}: two drives are named {name}: choose other names")
        number, unique = 1, name
        while unique in found:
            number += 1
            unique = f"{name}-{number}"
        found[unique] = Drive(unique, drive.folder, drive.arguments)
    return list(found.values())
