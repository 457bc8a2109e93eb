"""Evaluation protocols: trained networks on recordings with ground truth, beside a baseline that uses no image.

True depth is that of streets: simulated worlds, KITTI raw drives with LiDAR, and folders of images beside depth maps.
On other drives static surfaces are measured from neighbouring frames at a run's poses.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import write_atomically
from erfsfm.common.progress import Progress, silent
from erfsfm.common.readers.frame_range import EVERYTHING, FrameRange
from erfsfm.common.readers.images import list_images, read_depth_map, read_image
from erfsfm.common.readers.kitti import find_drives
from erfsfm.config import Fidelity
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import LARGEST_WIDTH, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.depth_metrics import (
    CAP_M,
    Crop,
    DepthErrors,
    depth_errors,
    mean_errors,
    mean_ratio,
    standard_error,
)
from erfsfm.evaluation.eigen import RawFrame, lidar_depth
from erfsfm.evaluation.pose_metrics import (
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
from erfsfm.inference import DepthPosePredictor, refuse_leak

_BASELINE = "median depth map"
_PICTURE_WIDTH = 620


def depth_protocol(
    networks: Mapping[str, DepthPosePredictor],
    roots: Sequence[Path],
    allow_leak: bool,
    progress: Progress = silent,
    pictures: Path | None = None,
) -> list[dict[str, Any]]:
    """Median-scaled depth errors under 80 m on the streets of all roots, each of which counts alike.

    Args:
        networks: to evaluate, by the name of their rows.
        roots: with true depth.
        allow_leak: evaluate also streets that networks were trained on.
        progress: told of the stage, what is done, and of how many.
        pictures: a folder that receives a picture of a frame of each street: image, median-scaled depths, and truth.

    Returns:
        A row for each networks, and, where depth is dense, one for the median depth map of a root, a baseline that
        uses no image. Of several streets these are means, ``abs_rel_se`` is the standard error over streets, and rows
        for each street follow. ``ratio`` is ``abs_rel`` over that of the first networks on the same street, of
        several streets the geometric mean, with its standard error over streets ``ratio_se``.

    Raises:
        DataError: no true depth under a root, or a leak that was not allowed.
    """
    streets = [street for root in roots for street in find_streets(root)]
    leaks = {
        name: [refuse_leak(each, street.seen, allow_leak) for street in streets]
        for name, each in networks.items()
    }
    total, done = sum(len(street.frames) for street in streets), 0
    errors: dict[str, list[list[DepthErrors]]] = {
        name: [[] for _ in streets] for name in (*networks, _BASELINE)
    }
    for place, street in enumerate(streets):
        to_draw = pictures
        for load in street.frames:
            progress("depth", done, total)
            image, truth = load()
            guesses = {name: each.depth(image) for name, each in networks.items()}
            if street.typical is not None:
                guesses[_BASELINE] = street.typical
            found = {
                name: depth_errors(guess, truth, CAP_M, street.crop)
                for name, guess in guesses.items()
            }
            compared = {name: error for name, error in found.items() if error is not None}
            for name, error in compared.items():
                errors[name][place].append(error)
            if to_draw is not None and compared:
                scaled = [guesses[name] * np.float32(compared[name].scale) for name in networks]
                jpeg, file = _picture(image, scaled, truth), f"{street.name.replace('/', '-')}.jpg"
                write_atomically(to_draw / file, jpeg)
                to_draw = None
            done += 1
        if not all(errors[name][place] for name in networks):
            raise DataError(
                f"no depth between 0 and {CAP_M:g} m in {street.name}: nothing to compare with"
            )
    return _depth_rows(networks, streets, errors, leaks)


def _depth_rows(
    networks: Mapping[str, DepthPosePredictor],
    streets: Sequence[Street],
    errors: Mapping[str, list[list[DepthErrors]]],
    leaks: Mapping[str, list[bool]],
) -> list[dict[str, Any]]:
    """Means of each method over streets, and, where there are several, a row for each street."""
    first = next(iter(networks))
    rows = []
    for name, compared in errors.items():
        if all(compared):
            before = None if name in (first, _BASELINE) else errors[first]
            rows.append(_depth_row(name, compared, before) | {"leak": any(leaks.get(name, ()))})
    for place, street in enumerate(streets if len(streets) > 1 else ()):
        for name in networks:
            row = _depth_row(
                name, [errors[name][place]], None if name == first else [errors[first][place]]
            )
            rows.append(row | {"leak": leaks[name][place], "street": street.name})
    return rows


def _picture(
    image: NDArray[np.uint8], depths: Iterable[NDArray[np.float32]], truth: NDArray[np.float32]
) -> bytes:
    """A JPEG, image, depths in metres and truth below each other, at most `_PICTURE_WIDTH` wide; near is bright."""
    known = truth > 0
    nearness = [1 / depth for depth in depths] + [np.where(known, 1 / np.where(known, truth, 1), 0)]
    height, width = (round(n * min(1, _PICTURE_WIDTH / image.shape[1])) for n in image.shape[:2])
    points = 1 + 2 * round(
        image.shape[1] / _PICTURE_WIDTH
    )  # of LiDAR, which would vanish in a smaller picture
    nearness[-1] = cv2.dilate(nearness[-1], np.ones((points, points)))
    brightest = np.percentile(nearness[-1][nearness[-1] > 0], 98)
    shades = [np.clip(values / brightest * 255, 0, 255).astype(np.uint8) for values in nearness]
    coloured = [cv2.applyColorMap(shade, cv2.COLORMAP_MAGMA) for shade in shades]
    rows = [
        cv2.resize(each, (width, height), interpolation=cv2.INTER_AREA)
        for each in (image[..., ::-1], *coloured)
    ]
    return bytes(cv2.imencode(".jpg", np.vstack(rows))[1])


def pose_protocol(
    networks: DepthPosePredictor,
    root: Path,
    sequences: Sequence[str],
    fidelity: Fidelity,
    allow_leak: bool,
) -> list[dict[str, Any]]:
    """Five-frame snippets of each sequence, or of a part of it (``00[250:300]``): the networks, the pose network alone
    where its guess is the start of a measurement, and constant velocity straight ahead.

    No snippet spans a gap, and a stretch between gaps that is shorter than one is passed over. In paper fidelity the
    truth is that of camera 0, whichever camera took the images.

    Raises:
        DataError: a sequence or its poses are missing, networks of another snippet length, or a leak that was
            not allowed.
    """
    length = networks.sources + 1
    rows = []
    for name in sequences:
        parts = named_recordings(root, name)
        first, last = parts[0], parts[-1]
        shown = (
            str(FrameRange(first.name, first.start, last.start + len(last)))
            if "[" in name
            else first.name
        )
        leak = refuse_leak(networks, [part.frames_name for part in parts], allow_leak)
        if length != 5:
            raise DataError(
                f"the snippet protocol needs networks with 4 sources; these have {networks.sources}"
            )
        snippets, predicted = [], defaultdict(list)
        for part in parts:
            T_world_camera = part.true_poses(fidelity)
            if T_world_camera is None:
                raise DataError(f"no true poses of sequence {name}: wanted {root}/poses/{name}.txt")
            snippets.append(snippets_from_trajectory(T_world_camera, length))
            for images in _windows(part, networks):
                guess = networks.guessed_poses(images)
                poses = networks.measured_poses(guess, images, part.camera)
                predicted["networks"].append(snippet_from_network(poses))
                if networks.measures:
                    predicted["pose network alone"].append(snippet_from_network(guess))
        if not predicted:
            longest = max(map(len, parts))
            raise DataError(f"{shown} has {longest} frames without a gap; a snippet needs {length}")
        true = np.concatenate(snippets)
        straight = np.tile(np.eye(4), (len(true), length, 1, 1))
        straight[:, :, 2, 3] = np.arange(length)
        predicted["straight constant motion"] = list(straight)
        for method, snippet_poses in predicted.items():
            errors = asdict(snippet_errors(np.stack(snippet_poses), true, fidelity=fidelity))
            count = errors.pop("count")
            rows.append(
                {"method": method, "recording": shown, **errors, "snippets": count, "leak": leak}
            )
    return rows


def named_recordings(root: Path, name: str) -> list[Recording]:
    """Recordings of a sequence, or their part that a name with frames means (``00[250:300]``); of its first camera.

    Without a name they are all recordings of the root.
    """
    if not name:
        return discover(root)
    found: dict[str, list[Recording]] = {}
    for each in discover(root):
        for known in {each.name, each.sequence or each.name}:
            found.setdefault(known, []).append(each)
    span = FrameRange(name, 0, EVERYTHING) if name in found else FrameRange.parse(name)
    if span.recording not in found:
        raise DataError(
            f"no sequence {span.recording} in {root}: found {', '.join(sorted(found)) or 'none'}"
        )
    camera = found[span.recording][0].images[0].parent
    wholes = [whole for whole in found[span.recording] if whole.images[0].parent == camera]
    parts = [whole.within(span.start, span.stop) for whole in wholes]
    chosen = [part for part in parts if part is not None]
    if not chosen:
        raise DataError(
            f"{name} names no frame of a recording: found {', '.join(w.frames_name for w in wholes)}"
        )
    return chosen


def _windows(
    recording: Recording, networks: DepthPosePredictor
) -> Iterator[list[NDArray[np.float32]]]:
    """The prepared images of each snippet; no more of them are held than one has."""
    images: deque[NDArray[np.float32]] = deque(maxlen=networks.sources + 1)
    for index in range(len(recording)):
        images.append(
            networks.prepare(
                recording.image(index, recording.camera.height, recording.camera.width)
            )
        )
        if len(images) == images.maxlen:
            yield list(images)


def _depth_row(
    method: str, streets: list[list[DepthErrors]], before: list[list[DepthErrors]] | None
) -> dict[str, Any]:
    """Means over streets of the means over their frames, and their ratio to those of other networks ``before``."""
    means = [mean_errors(errors) for errors in streets]
    abs_rel = [each.abs_rel for each in means]
    row: dict[str, Any] = {
        "method": method,
        **asdict(mean_errors(means)),
        "abs_rel_se": standard_error(abs_rel),
    }
    if before is not None:
        row["ratio"], row["ratio_se"] = mean_ratio(
            abs_rel, [mean_errors(errors).abs_rel for errors in before]
        )
    row |= {
        f"{key}_reason": "one street"
        for key in ("abs_rel_se", "ratio_se")
        if key in row and row[key] is None
    }
    scales = np.array([each.scale for errors in streets for each in errors])
    row["scale_spread"] = float(scales.std() / scales.mean())
    return row | {"images": len(scales), "streets": len(streets)}


CAP_HEIGHTS = 50.0  # camera heights: some 80 m from a car's roof
LARGEST_RATIO = 1.3  # of the bounds of a pixel's depth; wider ones are no truth
SLAM_WEIGHTS = "default"
TRUTH_FOLDER = "truth"
_RATIOS = ("abs_rel", "rmse_log", "a1", "a2", "a3")  # errors without a unit: the scale is fitted


def many_view_protocol(
    networks: DepthPosePredictor,
    recordings: Sequence[Recording],
    cache: Path | None,
    allow_leak: bool,
    progress: Progress,
) -> list[dict[str, Any]]:
    """Median-scaled depth errors where the many-view teacher knows the depth within ``LARGEST_RATIO``.

    What moves, shines or is seen by one neighbour alone is left out, so the errors are smaller than against LiDAR:
    compare rows of this protocol with each other.

    Args:
        networks: to evaluate.
        recordings: whole drives, or parts of them.
        cache: receives poses and depth, for the next call; forgotten where None.
        allow_leak: evaluate also frames that the networks were trained on.
        progress: told of the stage, what is done, and of how many.

    Returns:
        One row for each recording; ``known`` is the share of pixels that were compared.

    Raises:
        DataError: a leak that was not allowed, or no depth could be measured.
        TrainingError: a recording gives no trajectory or no scale.
    """
    leaks = [refuse_leak(networks, [each.frames_name], allow_leak) for each in recordings]
    rows = []
    with tempfile.TemporaryDirectory(prefix="erfsfm-truth-") as temporary:
        for recording, leak in zip(recordings, leaks):
            ratio = min(1.0, LARGEST_WIDTH / recording.camera.width)
            size = (round(recording.camera.height * ratio), round(recording.camera.width * ratio))
            # the teacher's labels are measured around a network's depth, and truth without any
            teacher = ManyViewTeacher((cache or Path(temporary)) / TRUTH_FOLDER, size, EVERY)
            teacher.prepare([recording], networks.sources, SLAM_WEIGHTS, progress)
            drive, errors, known = teacher.drive(recording), [], []
            for target in drive.targets(networks.sources):
                low, high = (bound.astype(np.float32) for bound in drive.label(target))
                narrow = (low > 0) & (high < LARGEST_RATIO * low)
                truth = np.zeros_like(low)  # where the bounds are too far apart
                truth[narrow] = 1 / np.sqrt(low[narrow] * high[narrow])
                error = depth_errors(
                    networks.depth(recording.image(target, *truth.shape)), truth, CAP_HEIGHTS
                )
                if error is not None:
                    errors.append(error)
                    known.append(float(np.mean((truth > 0) & (truth < CAP_HEIGHTS))))
            if not errors:
                raise DataError(
                    f"no depth could be measured in {recording.frames_name}: the camera has to travel"
                )
            mean, scales = mean_errors(errors), np.array([each.scale for each in errors])
            row: dict[str, Any] = {"method": "networks", "recording": recording.frames_name}
            row |= {key: getattr(mean, key) for key in _RATIOS}
            row |= {
                "scale_spread": float(scales.std() / scales.mean()),
                "known": float(np.mean(known)),
            }
            rows.append(row | {"images": len(errors), "leak": leak})
    return rows


EVERY = 5  # frames of a recording or drive, of which one is compared
IMAGES, TRUTH = "images", "truth"

Image = NDArray[np.uint8]
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class Street:
    """Frames of one drive in order.

    Attributes:
        name: of the drive, as the leak record writes it.
        seen: names with frames, for the leak record.
        frames: each gives an image ``(H, W, 3)`` and its true z-depth in metres ``(H, W)``, 0 where unknown.
        crop: part of the image that is compared.
        typical: a depth map that uses no image ``(H, W)``; None for LiDAR, whose points are few.
    """

    name: str
    seen: list[str]
    frames: list[Callable[[], tuple[Image, Depth]]]
    crop: Crop
    typical: Depth | None = None


def find_streets(root: Path) -> list[Street]:
    """Every street under a root: all pairs of a folder, every fifth frame of a recording or a drive.

    Raises:
        DataError: there is none, or depth maps of different sizes.
    """
    if not root.exists():
        raise DataError(f"no data set at {root}: the path does not exist")
    streets = _of_pairs(root) or _of_drives(root) or _of_recordings(root)
    if not streets:
        raise DataError(
            f"no true depth in {root}: wanted sequences/NN/depth_2 (erfsfm-slam simulate --depth), KITTI raw drives "
            f"with velodyne_points, or {IMAGES}/ and {TRUTH}/ with 16-bit depth maps (metres x 256) of the same names"
        )
    return streets


def _of_pairs(root: Path) -> list[Street]:
    """Images and depth maps of the same names; a street is what their names have before the last underscore."""
    if not ((root / IMAGES).is_dir() and (root / TRUTH).is_dir()):
        return []
    streets: dict[str, Street] = {}
    for image in list_images(root / IMAGES):
        truth = root / TRUTH / f"{image.stem}.png"
        if truth.is_file():
            before = image.stem.rpartition("_")[0]
            name = f"folder/{root.resolve().name}" + (f"/{before}" if before else "")
            street = streets.setdefault(name, Street(name, [name], [], "garg"))
            street.frames.append(partial(_pair, image, truth))
    return [*streets.values()]


def _pair(image_file: Path, truth_file: Path) -> tuple[Image, Depth]:
    image, truth = read_image(image_file), read_depth_map(truth_file).astype(np.float32)
    if image.shape[:2] != truth.shape:
        raise DataError(
            f"{truth_file} has size {truth.shape[::-1]}, and its image {image.shape[1::-1]}: give one size"
        )
    return image, truth


def _of_drives(root: Path) -> list[Street]:
    """KITTI raw drives by their scans, in the crop of Garg et al."""
    streets = []
    for drive, folder in find_drives(root).items():
        scans = sorted(
            int(path.stem) for path in (folder / "velodyne_points" / "data").glob("*.bin")
        )
        base = folder.absolute().parents[1]
        frames = [RawFrame(base, drive, index) for index in scans[::EVERY]]
        if frames:
            seen = [frame.name for frame in frames]
            streets.append(
                Street(
                    f"kitti_raw/{drive}", seen, [partial(_scan, frame) for frame in frames], "garg"
                )
            )
    return streets


def _scan(frame: RawFrame) -> tuple[Image, Depth]:
    image = read_image(frame.image_path())
    return image, lidar_depth(frame, image.shape[:2])


def _of_recordings(root: Path) -> list[Street]:
    """Recordings with depth maps; the parts of one between gaps are one street."""
    recordings = [recording for recording in discover(root) if any(recording.depth or ())]
    indices = [
        np.flatnonzero([file is not None for file in r.depth or ()])[::EVERY] for r in recordings
    ]
    frames = [
        (recording, int(index)) for recording, those in zip(recordings, indices) for index in those
    ]
    truths = [_truth(recording, index) for recording, index in frames]
    if len({truth.shape for truth in truths}) > 1:
        raise DataError(
            f"depth maps of different sizes in {root}: evaluate recordings of one size at a time"
        )
    streets: dict[str, Street] = {}
    typical = _median_map(truths) if truths else None
    for recording in recordings:
        street = streets.setdefault(recording.name, Street(recording.name, [], [], "none", typical))
        street.seen.append(recording.frames_name)
    for recording, index in frames:
        streets[recording.name].frames.append(partial(_frame, recording, index))
    return [*streets.values()]


def _truth(recording: Recording, index: int) -> Depth:
    truth = recording.true_depth(index)
    assert truth is not None, "frames with a depth map"
    return truth


def _frame(recording: Recording, index: int) -> tuple[Image, Depth]:
    truth = _truth(recording, index)
    return recording.image(index, *truth.shape), truth  # prepared images are smaller


def _median_map(truths: list[Depth]) -> Depth:
    """Per-pixel median of the true depth, the sky at the cap; every map has the first one's size."""
    stacked = np.stack([np.where((t > 0) & (t < CAP_M), t, np.nan) for t in truths])
    known = np.isfinite(stacked).any(axis=0)
    median = np.full(stacked.shape[1:], CAP_M, dtype=np.float32)
    median[known] = np.nanmedian(stacked[:, known], axis=0)
    return median
