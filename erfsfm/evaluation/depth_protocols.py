"""Protocols of depth: trained networks on streets with true depth, or on drives that have none.

On streets a baseline that uses no image stands beside the networks. On drives without truth static
surfaces are measured from neighbouring frames at a run's poses.
"""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import write_atomically
from erfsfm.common.processes import slam_process
from erfsfm.common.progress import Progress, silent
from erfsfm.data.many_view_teacher import LARGEST_WIDTH, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.depth_metrics import (
    CAP_M,
    DepthErrors,
    depth_errors,
    mean_errors,
    mean_ratio,
    standard_error,
)
from erfsfm.evaluation.streets import EVERY, Street, find_streets
from erfsfm.inference import DepthPosePredictor, colour_disparity, refuse_leak

logger = logging.getLogger(__name__)

_BASELINE = "median depth map"
_PICTURE_WIDTH = 620

CAP_HEIGHTS = 50.0  # camera heights: some 80 m from a car's roof
LARGEST_RATIO = 1.3  # of the bounds of a pixel's depth; wider ones are no truth
SLAM_WEIGHTS = "default"
TRUTH_FOLDER = "truth_by_flow"
# all frames
_RUN = "--set loops.enabled=false --set mapping.keyframe_distance_m=0.3 --set output.report=false"
_RATIOS = ("abs_rel", "rmse_log", "a1", "a2", "a3")  # errors without a unit: the scale is fitted


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
    leaks: dict[str, list[bool]] = {}
    for name, each in networks.items():
        leaks[name] = [refuse_leak(each, street.seen, allow_leak) for street in streets]
    total = sum(len(street.frames) for street in streets)
    done = 0
    errors: dict[str, list[list[DepthErrors]]] = {}
    for name in (*networks, _BASELINE):
        errors[name] = [[] for _ in streets]
    for place, street in enumerate(streets):
        to_draw = pictures
        for load in street.frames:
            progress("depth", done, total)
            image, truth = load()
            guesses = {name: each.depth(image) for name, each in networks.items()}
            if street.typical is not None:
                guesses[_BASELINE] = street.typical
            compared: dict[str, DepthErrors] = {}
            for name, guess in guesses.items():
                error = depth_errors(guess, truth, CAP_M, street.crop)
                if error is not None:
                    compared[name] = error
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


def refined_protocol(
    networks: DepthPosePredictor,
    weights: str,
    roots: Sequence[Path],
    allow_leak: bool,
    progress: Progress = silent,
) -> list[dict[str, Any]]:
    """Errors in metres under 80 m of the depth that a run gives its keyframes, learned and refined; nothing is scaled.

    A street that a run cannot measure, as one of fewer than five images in a row, is left out with a warning.

    Args:
        networks: whose leak record is read.
        weights: their name, for the runs.
        roots: with true depth, as those of `depth_protocol`.
        allow_leak: evaluate also streets that the networks were trained on.
        progress: told of the stage, what is done, and of how many.

    Returns:
        The mean over streets, with the standard error of ``refined``, and a row for each street. ``learned`` and
        ``refined`` are mean relative errors, the latter also ``by_range``; ``median`` is that of refined depth and
        ``in_90`` the share of its errors inside the 90 % bound. Where masks tell what moves, rows follow for what
        stands and what moves.

    Raises:
        DataError: no true depth under a root, no street that a run can measure, or a leak that was not allowed.
    """
    streets = [street for root in roots for street in find_streets(root)]
    seen = list(chain.from_iterable(street.seen for street in streets))
    leak = refuse_leak(networks, seen, allow_leak)
    whole: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for done, street in enumerate(streets):
        progress("runs", done, len(streets))
        for part in street.parts:
            name = f"{street.name} {part}".strip()
            depth = _depth_of_run(street, part, weights)
            if isinstance(depth, str):
                logger.warning("%s is left out: %s", name, depth)
                break
            refined = depth["refined"]
            row = {"street": name, "learned": depth["network"]["abs_rel"]}
            row |= {"refined": refined["abs_rel"], "median": refined["median_rel"]}
            row |= {"in_90": refined["coverage"]["90"], "frames": refined["frames"]}
            rows.append(row | {"by_range": refined["by_range"]})
            if not part:
                whole.append(row)
    if not whole:
        raise DataError("a run can measure no street: give at least five images in a row")
    mean: dict[str, Any] = {"street": "mean", "refined_se": None}
    for key in ("learned", "refined", "median", "in_90"):
        mean[key] = float(np.mean([row[key] for row in whole]))
    mean["refined_se"] = standard_error([row["refined"] for row in whole])
    return [mean | {"streets": len(whole), "leak": leak}, *rows]


def _depth_of_run(street: Street, part: str, weights: str) -> dict[str, Any] | str:
    """``depth`` of ``metrics.json`` of a run against a part of the truth, or why there is none."""
    with tempfile.TemporaryDirectory(prefix="erfsfm-refined-") as temporary:
        output = Path(temporary) / "run"
        words = [*street.drive(Path(temporary), part), "--output", str(output), *_RUN.split()]
        reason = slam_process(["run", "--weights", weights, *words])
        if reason:
            return reason
        depth: dict[str, Any] = json.loads((output / "metrics.json").read_text())["depth"]
    return depth if depth["refined"] else str(depth["refined_reason"])


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
    """A JPEG: image, depths in metres and truth below each other, at most `_PICTURE_WIDTH` wide; near is bright."""
    ratio = min(1, _PICTURE_WIDTH / image.shape[1])
    points = np.ones((1 + 2 * round(1 / ratio),) * 2)  # of LiDAR, which would vanish when shrunk
    measured = cv2.erode(np.where(truth > 0, truth, np.inf), points).astype(np.float32)
    shown = np.vstack([image, colour_disparity(np.vstack([*depths, measured]))])[..., ::-1]
    shrunk = cv2.resize(shown, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", shrunk)[1])


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
    for key in ("abs_rel_se", "ratio_se"):
        if key in row and row[key] is None:
            row[f"{key}_reason"] = "one street"
    scales = np.array([each.scale for each in chain.from_iterable(streets)])
    row["scale_spread"] = float(scales.std() / scales.mean())
    return row | {"images": len(scales), "streets": len(streets)}


def for_a_table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What of streets' rows fits into a table of 80 columns; other rows as they are."""
    if "refined_se" in rows[0]:
        keys = ("street", "learned", "refined", "refined_se", "median", "in_90", "frames")
        return [{key: row[key] for key in keys if key in row} for row in rows]
    if "abs_rel_se" not in rows[0]:
        return rows
    compares = any("ratio" in row for row in rows)
    shown = []
    for row in rows:
        head = {"street": row.get("street", "mean"), "weights": row["method"]}
        errors = {"abs_rel": row["abs_rel"], "se": row["abs_rel_se"]}
        if compares:
            shown.append(
                head | errors | {"ratio": row.get("ratio"), "ratio se": row.get("ratio_se")}
            )
        else:
            errors |= {key: row[key] for key in ("rmse", "a1", "images", "leak")}
            shown.append({"method": row.get("street", row["method"])} | errors)
    return shown


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
