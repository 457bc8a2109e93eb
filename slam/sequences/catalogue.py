"""Opening of sequences: recognises the kind of a data set and chooses a sequence of it."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from pathlib import Path

from erfsfm.common.errors import DataError
from erfsfm.common.readers.kitti import drive_name, find_odometry_root
from erfsfm.common.readers.video import VIDEO_SUFFIXES
from slam.runtime.errors import SequenceError, sequence_errors
from slam.runtime.imports import import_plug_in, plug_ins
from slam.sequences import folder, kitti, layouts
from slam.sequences.camera_file import as_known
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import read_truth
from slam.sequences.recording import RecordedSequence, frame_range
from slam.sequences.ros import loader as ros
from slam.sequences.series import find_series, open_series

KITTI_VARIABLE = "KITTI_ODOMETRY"
KITTI_NAME = "KITTI"
EMBEDDED_SEED = 640  # no weights saw it
EMBEDDED_FRAMES = 320

PLUG_INS = "erfsfm_slam.sequences"  # entry points of other packages: each names a `Loader`

# the first that recognises a path opens it; loaders of other packages come before these
LOADERS: tuple[Loader, ...] = (*kitti.LOADERS, *layouts.LOADERS, folder.IMAGES, ros.LOADER, folder.VIDEO)


@sequence_errors()
def open_sequence(
    dataset: Path | None = None,
    name: str | None = None,
    camera: Path | None = None,
    frames: str | None = None,
    truth: Path | None = None,
) -> RecordedSequence:
    """Open a sequence of any kind.

    Args:
        dataset: a data set of one of the ``LOADERS``, or a folder of several, or the word ``KITTI`` for
            ``$KITTI_ODOMETRY``. Without it, a name is searched in ``$KITTI_ODOMETRY``; without either, the embedded
            simulated sequence is opened.
        name: which sequence of ``dataset``; optional where there is one only.
        camera: a ``camera.yaml``, or ``fov=DEGREES``; it replaces the calibration of the data set.
        frames: ``A:B``, half-open, as Python reads a slice.
        truth: its true poses, in place of those that the data set has.

    Raises:
        SequenceError: one line on what was searched, where, what was found and what to do.
    """
    if dataset is None and name is None:
        for what, given in (("a camera file", camera), ("a file of true poses", truth)):
            if given is not None:
                raise SequenceError(f"{what} ({given}) without a data set: give --dataset as well")
        # rendering needs Open3D, which is slow to import
        from slam.sequences.simulated import SimulatedSequence
        from slam.simulation.options import SimulationOptions

        options = SimulationOptions(route="loop", frames=EMBEDDED_FRAMES, seed=EMBEDDED_SEED)
        sequence: RecordedSequence = SimulatedSequence(options)
    else:
        root = _root(dataset, name)
        sequence = _choose(root, Asked(name, camera))
        sequence.intrinsics = as_known(sequence.intrinsics, camera)
    if truth is not None:
        sequence.take_truth(read_truth(truth, sequence.stamps))
    return sequence if frames is None else sequence.cut(*frame_range(frames, len(sequence)))


@sequence_errors()
def sequence_kinds(dataset: Path) -> dict[str, str]:
    """The sequences of a data set by name, and the kind of each; empty where it is of no known kind."""
    return {name: kind for name, (kind, _) in _contents(_root(dataset, None), Asked()).items()}


def _root(dataset: Path | None, name: str | None) -> Path:
    """The path given by the user or by the environment."""
    variable = os.environ.get(KITTI_VARIABLE)
    if dataset is None or (str(dataset) == KITTI_NAME and (variable or not dataset.exists())):
        if not variable:
            wanted = f"sequence {name}" if name else f"data set {KITTI_NAME}"
            raise SequenceError(
                f"{wanted} is looked for in ${KITTI_VARIABLE}, which is not set: set it to a KITTI odometry "
                f"root or give --dataset ROOT"
            )
        path, origin = Path(variable).expanduser(), f" (${KITTI_VARIABLE})"
    else:
        path, origin = dataset.expanduser(), ""
    if not path.exists():
        raise SequenceError(f"no data set at {path}{origin}: check the path")
    if not (path.is_file() or path.is_dir()):
        raise SequenceError(f"{path}{origin} is neither a file nor a folder: give a recording")
    return path


def _contents(root: Path, asked: Asked) -> dict[str, tuple[str, Opener]]:
    """Kind and opener of what a path holds, pieces of one recording as one; empty where nothing is of a known kind."""
    found = _parts(root, asked)
    for pieces in find_series({name: kind for name, (kind, _) in found.items()}):
        kind, openers = found[pieces[0].name][0], [found.pop(piece.name)[1] for piece in pieces]
        found[pieces[0].name] = kind, partial(open_series, pieces, openers)
    return found


def _parts(root: Path, asked: Asked) -> dict[str, tuple[str, Opener]]:
    """What a path holds, or else the folders in it."""
    found = _recognised(root, asked)
    if found or root.is_file():
        return found
    for child in sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")):
        with suppress(DataError, SequenceError):  # a folder that is refused when it is given
            inside = _recognised(child, Asked(None, asked.camera))
            found |= {child.name if len(inside) == 1 else f"{child.name}/{name}": inside[name] for name in inside}
    return found


def _loaders() -> tuple[Loader, ...]:
    return (*map(import_plug_in, plug_ins(PLUG_INS).values()), *LOADERS)


def _recognised(root: Path, asked: Asked) -> dict[str, tuple[str, Opener]]:
    for loader in _loaders():
        openers = loader.find(root, asked)
        if openers:
            return {name: (loader.kind, opener) for name, opener in openers.items()}
    return {}


def _choose(root: Path, asked: Asked) -> RecordedSequence:
    """Open the sequence by its name, or the only one."""
    contents, name = _contents(root, asked), asked.name
    if name is not None and name not in contents and not Path(name).is_absolute() and (root / name).exists():
        return _choose(root / name, Asked(None, asked.camera))
    if not contents:
        raise SequenceError(_unknown(root))
    found = ", ".join(contents)
    if name is None:
        if len(contents) > 1:
            raise SequenceError(f"{root} has {len(contents)} sequences: {found}; choose one with --sequence")
        (name,) = contents
    name = drive_name(name) if drive_name(name) in contents else name
    if name not in contents:
        odometry = find_odometry_root(root)
        under = root if odometry is None else odometry.sequences
        raise SequenceError(
            f"no sequence {name} in {root}: found {found} under {under}; choose one of them with --sequence"
        )
    return contents[name][1]()


def _unknown(root: Path) -> str:
    if root.is_file():
        known = ", ".join(suffix[1:] for suffix in VIDEO_SUFFIXES)
        return f"{root} is no video ({known}) and no bag (bag, db3, mcap): give one, or the folder of a data set"
    odometry = find_odometry_root(root)
    if odometry is not None:
        return (
            f"no sequence with images under {odometry.sequences}: looked for png or jpg in */image_2, image_3, "
            f"image_0, image_1; found {_listed(odometry.sequences)}; unpack the images there"
        )
    looked = ", ".join(f"{loader.layout} ({loader.kind})" for loader in _loaders())
    return f"{root} is no data set: looked for {looked}; found {_listed(root)}; check the path"


def _listed(folder: Path) -> str:
    names = sorted(path.name for path in folder.iterdir())
    shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    return shown or "an empty folder"
