"""Opening of sequences: detects the kind of a data set and chooses a sequence of it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from erfsfm.readers.camera_file import CameraFile
from erfsfm.readers.folder import image_folder
from erfsfm.readers.kitti_drives import OdometryRoot, drive_name, find_drives, find_odometry_root, odometry_camera
from erfsfm.readers.video import VIDEO_SUFFIXES, list_videos
from slam.errors import SequenceError, sequence_errors
from slam.frames import Sequence
from slam.sequences import tum
from slam.sequences.camera_file import find_camera_file, read_explicit
from slam.sequences.excerpt import Excerpt, SourcedSequence, frame_range
from slam.sequences.folder import open_folder
from slam.sequences.kitti.odometry import open_kitti_odometry
from slam.sequences.kitti.raw import open_kitti_raw
from slam.sequences.video import open_video

KITTI_VARIABLE = "KITTI_ODOMETRY"
KITTI_NAME = "KITTI"
EMBEDDED_SEED = 1000
EMBEDDED_FRAMES = 320

Opener = Callable[[], SourcedSequence]


@sequence_errors()
def open_sequence(
    dataset: Path | None = None,
    name: str | None = None,
    camera: Path | None = None,
    frames: str | None = None,
) -> Sequence:
    """Open a sequence of any kind.

    Args:
        dataset: a KITTI odometry root, a KITTI raw drive or the folder of several, a TUM folder, a folder
            of images, a video, or the word ``KITTI`` for ``$KITTI_ODOMETRY``. Without it, a name is searched
            in ``$KITTI_ODOMETRY``; without either, the embedded simulated sequence is opened.
        name: which sequence of ``dataset``; optional where there is one only.
        camera: a ``camera.yaml``; it replaces the calibration of the data set.
        frames: ``A:B``, half-open, as Python reads a slice.

    Returns:
        The sequence, or the ``Excerpt`` of it.

    Raises:
        SequenceError: one line on what was searched, where, what was found and what to do.
    """
    if dataset is None and name is None:
        if camera is not None:
            raise SequenceError(f"a camera file ({camera}) without a data set: give --dataset as well")
        sequence = _open_embedded()
    else:
        root = _root(dataset, name)
        sequence = _choose(_openers(root, name, camera), root, name)
    if frames is None:
        return sequence
    return Excerpt(sequence, *frame_range(frames, len(sequence)))


@sequence_errors()
def sequence_names(dataset: Path) -> list[str]:
    """Names of the sequences in a data set, for a list; empty where it is of no known kind.

    Raises:
        SequenceError: if the path does not exist.
    """
    return list(_openers(_root(dataset, None), None, None))


def _open_embedded() -> SourcedSequence:
    # rendering needs Open3D, which is slow to import
    from slam.sequences.simulation.sequence import SimulatedSequence
    from slam.sequences.simulation.street import SimulationOptions

    return SimulatedSequence(SimulationOptions(route="loop", frames=EMBEDDED_FRAMES, seed=EMBEDDED_SEED))


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
        path, origin = Path(variable).expanduser(), f"${KITTI_VARIABLE}"
    else:
        path, origin = dataset.expanduser(), "--dataset"
    if not path.exists():
        raise SequenceError(f"no data set at {path} ({origin}): check the path")
    return path


def _openers(root: Path, name: str | None, camera: Path | None) -> dict[str, Opener]:
    """What a path holds: sequence names and how to open each; empty where it is of no known kind."""
    if root.is_file():
        return _video(root, camera)
    kitti = find_odometry_root(root)
    if kitti is not None:
        names = kitti.names()
        if name is not None and name not in names and (kitti.sequences / name).is_dir():
            names.append(name)  # for the error about what it lacks
        return {n: _odometry(kitti, n, camera) for n in names}
    where = root.absolute()
    above = find_odometry_root(where.parent) if where.parent.name == "sequences" else None
    if above is not None and odometry_camera(root) is not None:
        return {where.name: _odometry(above, where.name, camera)}
    drives = find_drives(root)
    if drives:
        return {n: _raw(drive, camera) for n, drive in drives.items()}
    if name is not None and (root / name).exists():
        return {name: lambda: _choose(_openers(root / name, None, camera), root / name, None)}
    return _own(root, camera)


def _own(root: Path, camera: Path | None) -> dict[str, Opener]:
    """A folder in another format: TUM, images or one video."""
    where = root.absolute()
    if (root / tum.INDEX_FILE).is_file():
        return {
            where.name: lambda: tum.open_tum(
                root, find_camera_file(camera, root, where.parent, wanted_by=f"TUM folder {root}")
            )
        }
    images = image_folder(root)
    if images is not None:
        return {
            where.name: lambda: open_folder(
                root, find_camera_file(camera, images, root, where.parent, wanted_by=f"images in {images}")
            )
        }
    return {name: opener for path in list_videos(root) for name, opener in _video(path, camera).items()}


def _odometry(root: OdometryRoot, name: str, camera: Path | None) -> Opener:
    return lambda: open_kitti_odometry(root, name, _explicit(camera))


def _raw(drive: Path, camera: Path | None) -> Opener:
    return lambda: open_kitti_raw(drive, _explicit(camera))


def _video(path: Path, camera: Path | None) -> dict[str, Opener]:
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        known = ", ".join(suffix[1:] for suffix in VIDEO_SUFFIXES)
        raise SequenceError(f"{path} is no video ({known}): give a video, or the folder of a data set")
    folder = path.absolute().parent
    return {path.stem: lambda: open_video(path, find_camera_file(camera, folder, wanted_by=f"video {path}"))}


def _explicit(camera: Path | None) -> CameraFile | None:
    return None if camera is None else read_explicit(camera)


def _choose(openers: dict[str, Opener], root: Path, name: str | None) -> SourcedSequence:
    """Open the sequence by its name, or the only one."""
    if not openers:
        raise SequenceError(_unknown(root))
    found = ", ".join(openers)
    if name is None:
        if len(openers) > 1:
            raise SequenceError(f"{root} has {len(openers)} sequences: {found}; choose one with --sequence")
        (name,) = openers
    name = name if name in openers else drive_name(name)
    if name not in openers:
        kitti = find_odometry_root(root)
        under = root if kitti is None else kitti.sequences
        raise SequenceError(
            f"no sequence {name} in {root}: found {found} under {under}; choose one of them with --sequence"
        )
    return openers[name]()


def _unknown(root: Path) -> str:
    kitti = find_odometry_root(root)
    if kitti is not None:
        return (
            f"no sequence with images under {kitti.sequences}: looked for png or jpg in */image_2, image_3, "
            f"image_0, image_1; found {_contents(kitti.sequences)}; unpack the images there"
        )
    return (
        f"{root} is no data set: looked for sequences/NN (KITTI odometry), DATE_drive_NNNN_sync (KITTI raw), "
        f"rgb.txt (TUM), images or a video; found {_contents(root)}; check the path"
    )


def _contents(folder: Path) -> str:
    names = sorted(path.name for path in folder.iterdir())
    shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    return shown or "an empty folder"
