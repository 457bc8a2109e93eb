"""KITTI's names and folders: raw drives, odometry roots, and which sequence was cut from which drive (Geiger 2013).

Raw drives lie in ``ROOT/2011_09_26/2011_09_26_drive_0013_sync/{image_02,oxts,...}``, odometry sequences in
``ROOT/sequences/NN/{image_2,calib.txt,times.txt}`` with ``ROOT/poses/NN.txt``.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import has_images, natural_key

ODOMETRY_CAMERAS = (2, 3, 0, 1)  # left and right colour, left and right grey
RAW_CAMERAS = ("02", "03", "00", "01")
SIMULATION_FILE = "simulation.json"
_DRIVE = re.compile(r"(?P<name>\d{4}_\d\d_\d\d_drive_\d{4})_(?P<kind>sync|extract)")
_DATE = re.compile(r"\d{4}_\d\d_\d\d")

# odometry sequence -> the raw drive it was cut from, its first and one past its last frame there
# (development kit, readme of the odometry benchmark)
ODOMETRY_DRIVES = {
    "00": ("2011_10_03_drive_0027", 0, 4541),
    "01": ("2011_10_03_drive_0042", 0, 1101),
    "02": ("2011_10_03_drive_0034", 0, 4661),
    "03": ("2011_09_26_drive_0067", 0, 801),
    "04": ("2011_09_30_drive_0016", 0, 271),
    "05": ("2011_09_30_drive_0018", 0, 2761),
    "06": ("2011_09_30_drive_0020", 0, 1101),
    "07": ("2011_09_30_drive_0027", 0, 1101),
    "08": ("2011_09_30_drive_0028", 1100, 5171),
    "09": ("2011_09_30_drive_0033", 0, 1591),
    "10": ("2011_09_30_drive_0034", 0, 1201),
}


@dataclass(frozen=True)
class OdometryRoot:
    """An odometry root; ``base`` is the folder with ``sequences`` and ``poses``."""

    base: Path
    sequences: Path

    def folders(self) -> list[Path]:
        """The folder of every sequence, in natural order."""
        return sorted((p for p in self.sequences.iterdir() if p.is_dir()), key=natural_key)

    def names(self) -> list[str]:
        """Sequences that have images."""
        return [folder.name for folder in self.folders() if odometry_camera(folder) is not None]

    def simulation_seed(self) -> int | None:
        """The seed of a simulated world; None of a real root.

        Raises:
            DataError: the file that has the seed is damaged.
        """
        path = self.base / SIMULATION_FILE
        if not path.is_file():
            return None
        try:
            return int(json.loads(path.read_text(encoding="utf-8"))["seed"])
        except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise DataError(f"{path} must hold the simulation's seed: {error!r}; simulate again") from error

    def recording_name(self, sequence: str) -> str:
        """A sequence in the leak record: the simulated world by its seed, or the KITTI sequence by its number."""
        seed = self.simulation_seed()
        return f"kitti_odometry/{sequence}" if seed is None else f"simulated/{seed}"


def find_odometry_root(dataset: Path) -> OdometryRoot | None:
    """Recognise a root: the folder above ``sequences`` or ``dataset/sequences``, or ``sequences`` itself."""
    for base in (dataset, dataset / "dataset"):
        if (base / "sequences").is_dir():
            return OdometryRoot(base, base / "sequences")
    if dataset.is_dir() and dataset.absolute().name == "sequences":
        return OdometryRoot(dataset.absolute().parent, dataset)
    return None


def odometry_camera(folder: Path) -> int | None:
    """The camera of a sequence to use: colour before grey, left before right; None without any images."""
    return next((camera for camera in ODOMETRY_CAMERAS if has_images(folder / f"image_{camera}")), None)


def find_drives(dataset: Path) -> dict[str, Path]:
    """Rectified drives by name (``2011_09_26_drive_0013``): the folder itself, those in it, or those in its dates.

    Raises:
        DataError: the folder is an unrectified (``_extract``) drive.
    """
    own = _DRIVE.fullmatch(dataset.absolute().name)
    if own is not None:
        if own["kind"] == "extract":
            raise DataError(f"{dataset} is not rectified: download the drive as synced+rectified (_sync)")
        return {own["name"]: dataset}
    if not dataset.is_dir():
        return {}
    dates = [path for path in dataset.iterdir() if _DATE.fullmatch(path.name) and path.is_dir()]
    drives = {}
    for folder in (dataset, *dates):
        for path in folder.iterdir():
            match = _DRIVE.fullmatch(path.name)
            if match is not None and match["kind"] == "sync" and path.is_dir():
                drives[match["name"]] = path
    return dict(sorted(drives.items()))


def drive_name(text: str) -> str:
    """The canonical name of a drive that a user writes with or without its date folder and ``_sync``."""
    return Path(text).name.removesuffix("_sync")
