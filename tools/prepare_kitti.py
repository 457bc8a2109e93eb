"""Shrink KITTI once: an odometry root or raw drives at another size, in the same layout, with the intrinsics moved.

Training decodes images again and again; at 416x128 a drive takes a tenth of the space and time. Every file appears
whole or not at all, and an interrupted run can be repeated: existing files are kept.

Example: python tools/prepare_kitti.py KITTI small --width 416 --height 128 --workers 4
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from shared.command import one_line_errors, parser_of

from erfsfm.common.errors import DataError
from erfsfm.common.files import write_atomically
from erfsfm.common.readers.images import image_size, list_images, read_values, resize_image

MARK = "prepared.json"
CAMERAS = ("image_0", "image_1", "image_2", "image_3")
RAW_CAMERAS = ("image_00", "image_01", "image_02", "image_03")
JPG_QUALITY = 95


@dataclass(frozen=True)
class Size:
    """Of images, pixels."""

    width: int
    height: int


@dataclass(frozen=True)
class Job:
    """One file to write: an image to shrink, or a file to copy."""

    source: Path
    target: Path
    size: Size | None = None


@one_line_errors()
def main() -> None:
    """Write the small copy."""
    parser = parser_of(__doc__)
    parser.add_argument("root", type=Path, help="odometry root (sequences/NN), or raw root (2011_09_26/..._sync)")
    parser.add_argument("output", type=Path, help="receives the same layout")
    parser.add_argument("--width", type=int, default=416, help="of the images, pixels")
    parser.add_argument("--height", type=int, default=128, help="of the images, pixels")
    parser.add_argument("--sequence", action="append", help="only this sequence or drive; repeat")
    parser.add_argument("--scans", action="store_true", help="copy the LiDAR scans too")
    parser.add_argument("--jpg", action="store_true", help="write jpg, also of png")
    parser.add_argument("--workers", type=int, default=2, help="threads")
    arguments = parser.parse_args()
    size, choice = Size(arguments.width, arguments.height), (arguments.sequence, arguments.scans, arguments.jpg)
    written, kept = prepare(arguments.root, arguments.output, size, *choice, arguments.workers)
    print(f"{written} files written, {kept} kept in {arguments.output}")


def prepare(
    root: Path,
    output: Path,
    size: Size,
    only: list[str] | None = None,
    scans: bool = False,
    jpg: bool = False,
    workers: int = 2,
) -> tuple[int, int]:
    """Write what is not there yet.

    Returns:
        How many files were written, and how many were there.

    Raises:
        DataError: no KITTI data, a sequence that is not there, a damaged image, or an output of another size.
    """
    if min(size.width, size.height) < 1:
        raise DataError(f"images must have at least one pixel; got {size.width}x{size.height}")
    if output.resolve() == root.resolve():
        raise DataError(f"{output} is the data set itself: choose another output")
    base = root / "dataset" if (root / "dataset" / "sequences").is_dir() else root
    odometry = (base / "sequences").is_dir()
    found = sorted((base / "sequences").iterdir()) if odometry else sorted(base.glob("????_??_??/*_sync"))
    drives = [drive for drive in found if drive.is_dir() and (only is None or _called(drive, only))]
    if not drives:
        names = ", ".join(drive.name for drive in found[:8]) or "none"
        raise DataError(
            f"no sequences/NN or 2011_09_26/..._sync to prepare in {root}; wanted {only or 'any'}, found {names}"
        )
    _check_mark(output, size)
    jobs = [
        job for drive in drives for job in _jobs(drive, output / drive.relative_to(base), size, odometry, scans, jpg)
    ]
    if odometry:
        jobs += [Job(path, output / path.relative_to(base)) for path in sorted((base / "poses").glob("*.txt"))]
    missing = [job for job in jobs if not job.target.exists()]
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        for _ in pool.map(_write, missing):
            pass
    for drive in drives:
        _write_calibration(drive, output / drive.relative_to(base), size, odometry)
    return len(missing), len(jobs) - len(missing)


def _called(drive: Path, names: list[str]) -> bool:
    return bool({drive.name, drive.name.removesuffix("_sync")} & set(names))


def _check_mark(output: Path, size: Size) -> None:
    """Refuse an output that was begun at another image size."""
    mark, wanted = output / MARK, {"width": size.width, "height": size.height}
    if mark.exists():
        had = json.loads(mark.read_text())
        if had != wanted:
            raise DataError(
                f"{output} was begun at {had['width']}x{had['height']}; wanted {size.width}x{size.height}: "
                "choose another output, or delete it"
            )
        return
    output.mkdir(parents=True, exist_ok=True)
    write_atomically(mark, lambda path: path.write_text(json.dumps(wanted)))


def _jobs(drive: Path, target: Path, size: Size, odometry: bool, scans: bool, jpg: bool) -> Iterator[Job]:
    for camera in CAMERAS if odometry else RAW_CAMERAS:
        folder = Path(camera) if odometry else Path(camera) / "data"
        if (drive / folder).is_dir():
            for image in list_images(drive / folder):
                yield Job(image, target / folder / (f"{image.stem}.jpg" if jpg else image.name), size)
    patterns = ["times.txt"] if odometry else ["image_0?/timestamps.txt", "oxts/**/*.txt"]
    if scans:
        patterns += ["velodyne/*.bin"] if odometry else ["velodyne_points/**/*.*"]
    for pattern in patterns:
        yield from (Job(path, target / path.relative_to(drive)) for path in sorted(drive.glob(pattern)))


def _write(job: Job) -> None:
    if job.size is None:
        content = job.source.read_bytes()
    else:
        small = resize_image(read_values(job.source), job.size.height, job.size.width)
        options = [] if job.target.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, JPG_QUALITY]
        content = cv2.imencode(job.target.suffix, small, options)[1].tobytes()
    write_atomically(job.target, lambda path: path.write_bytes(content))


def _write_calibration(drive: Path, target: Path, size: Size, odometry: bool) -> None:
    """Moved intrinsics, written again each time: they are small and depend on the source alone."""
    if odometry:
        folders = [drive / camera for camera in CAMERAS if (drive / camera).is_dir()]
        if not folders:
            raise DataError(f"{drive} has no images: wanted {', '.join(CAMERAS)}")
        height, width = image_size(list_images(folders[0])[0])
        lines = _lines(drive / "calib.txt")
        moved = [_moved(key, text, Size(width, height), size) if key[:1] == "P" else text for key, text in lines]
        _write_lines(target / "calib.txt", lines, moved)
        return
    for path in sorted(drive.parent.glob("calib_*.txt")):
        lines = _lines(path)
        sizes = {key[-2:]: text.split() for key, text in lines if key.startswith("S_rect_")}
        moved = []
        for key, text in lines:
            if key.startswith("S_rect_"):
                text = f"{size.width:e} {size.height:e}"
            elif key.startswith("P_rect_"):
                width, height = (int(float(number)) for number in sizes[key[-2:]])
                text = _moved(key, text, Size(width, height), size)
            moved.append(text)
        _write_lines(target.parent / path.name, lines, moved)


def _lines(path: Path) -> list[tuple[str, str]]:
    if not path.is_file():
        raise DataError(f"{path} is missing: the intrinsics could not follow the images")
    parts = (line.partition(":") for line in path.read_text().splitlines() if ":" in line)
    return [(key.strip(), text.strip()) for key, _, text in parts]


def _write_lines(path: Path, lines: list[tuple[str, str]], texts: list[str]) -> None:
    content = "".join(f"{key}: {text}\n" for (key, _), text in zip(lines, texts))
    write_atomically(path, lambda temporary: temporary.write_text(content))


def _moved(key: str, text: str, full: Size, small: Size) -> str:
    """A projection matrix of the resized image: u' = (u + 1/2) s - 1/2, so that pixel centres map to pixel centres."""
    numbers = [float(number) for number in text.split()]
    if len(numbers) != 12:
        raise DataError(f"row {key} of the calibration must have 12 numbers; got {len(numbers)}")
    sx, sy = small.width / full.width, small.height / full.height
    resize = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    return " ".join(f"{number:.12e}" for number in (resize @ np.reshape(numbers, (3, 4))).ravel())


if __name__ == "__main__":
    main()
