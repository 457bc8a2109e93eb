"""How good a run is in one sentence, what speaks for it and what raises doubt, by its ``metrics.json``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from slam.frontend.agreement import DOUBTFUL
from slam.results.metrics import CAMERA_HEIGHTS, METRES, Metrics

_FROM = {
    "camera-height": "the camera's height over the road",
    "lidar": "LiDAR",
    "gps": "GPS",
    "known": "a known distance",
    "reference": "the truth itself, so that it is no result",
}
_WIDE_SPREAD = 0.15  # of the scale
_LARGEST_SCALE_ERROR = 0.03
_SURE = 0.5
# per cent of the factors inside the bounds of their noise, and the share by which fewer are a doubt
_LEVELS, _NOISE_POINTS = (50, 90, 95), 0.12
_LEAST_FUSED = 0.15  # of the depth of all keyframes: maps of streets and rooms have 0.35 to 0.6


@dataclass(frozen=True)
class Verdict:
    """A sentence, signs that speak for the run, doubts, and why its map is no more than ``scraps``."""

    sentence: str
    signs: Sequence[str]
    doubts: Sequence[str]
    scraps: str = ""


def verdict(metrics: Metrics) -> Verdict | None:
    """What the numbers say; None of a run that did not end well."""
    if metrics.failure:
        return None
    scraps = _scraps(metrics)
    said = [
        *_confidence(metrics),
        *_loops(metrics),
        *_agreement(metrics),
        *_unit(metrics),
        *_noise(metrics),
        *_rest(metrics),
        (False, scraps),
    ]
    signs = [words for is_sign, words in said if is_sign]
    doubts = [words for is_sign, words in said if words and not is_sign]
    return Verdict(_sentence(metrics), signs, doubts, scraps)


def how_sure(metrics: Metrics) -> tuple[float | None, str]:
    """The confidence and what it is the share of: of the shape alone where none is known of the run."""
    known = metrics.confidence
    if known.run is not None:
        return known.run, "err by at most 1 % of their path"
    within = percent(known.shape_within or 0.0)
    return known.shape, f"err in shape, after one fitted scale, by at most {within} of their path"


def percent(share: float) -> str:
    """A share as words, with two digits where it is small."""
    return f"{100 * share:.2g} %" if abs(share) < 0.1 else f"{100 * share:.0f} %"


def _sentence(metrics: Metrics) -> str:
    align, length = metrics.trajectories.optimised.align, metrics.sequence.length_m
    error = (align.dof6 if metrics.is_metric else align.dof7).ate_rmse_m
    unit = "are in camera heights over the learned road, not in metres"
    unit = f"its lengths {unit if metrics.unit == CAMERA_HEIGHTS else 'have no metric unit'}"
    if error is None:
        sure, words = how_sure(metrics)
        likely = f": {percent(sure)} of drives like it {words}" if sure is not None else ""
        closed = next((f", and {words}" for is_sign, words in _loops(metrics) if is_sign), "")
        unit = "its lengths are in metres" if metrics.is_metric else unit
        return f"Without a truth its error is unknown{likely}{closed}; {unit}."
    part = f", {percent(error / length)} of its {length:.3g} m" if length else ""
    after = f"after one fitted scale; {unit}"
    if metrics.is_metric:
        after = (
            "with its scale from the truth"
            if metrics.scale.mode == "reference"
            else "with its own metric scale"
        )
    return f"The trajectory is {error:.2g} m off the truth (RMSE{part}), {after}."


def _unit(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    scale, spread = metrics.scale, metrics.scale.spread
    if metrics.unit == METRES and (source := _FROM.get(scale.mode or "")):
        certain = f" (spread {percent(spread)})" if spread is not None else ""
        yield (
            scale.mode != "reference" and (spread or 0.0) < _WIDE_SPREAD,
            f"metres come from {source}{certain}",
        )
    fitted = metrics.trajectories.optimised.align.dof7.scale
    if metrics.is_metric and fitted and abs(fitted - 1.0) > _LARGEST_SCALE_ERROR:
        yield (
            False,
            f"lengths are {percent(abs(1.0 / fitted - 1.0))} too {'short' if fitted > 1.0 else 'long'}",
        )


def _loops(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    accepted = metrics.loops.accepted
    if accepted:
        yield (
            True,
            f"{accepted} of {_count(metrics.loops.verified or accepted, 'measured loop')} agree and close it",
        )
    elif accepted == 0:
        yield False, f"no loop closes it ({metrics.loops.candidates} candidates), so drift adds up"
    else:
        yield False, f"drift adds up: {metrics.loops.why('accepted')}"


def _confidence(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    sure, words = how_sure(metrics)
    if sure is not None:
        yield sure > _SURE, f"{percent(sure)} of drives with images like its own {words}"
    elif not metrics.confidence.absent:
        yield False, f"its confidence is not known: {metrics.confidence.why('run')}"


def _agreement(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    for each in metrics.agreement or ():
        agrees = (each.sigmas or 0.0) <= DOUBTFUL
        if each.beside == "the images":
            yield (
                agrees,
                f"{each.source} {'agrees with' if agrees else 'contradicts'} the images: {each.figure}",
            )
        elif not agrees:  # `_confidence` says of all whether the run is like good ones
            yield False, f"{each.source}: {each.figure}"
    off = metrics.gps.optimised.horizontal_rmse_m
    if off is not None:
        within = "" if metrics.gps.in_graph is True else ", which it did not use"
        yield True, f"it stays within {off:.2g} m (RMSE) of the GPS track{within}"


def _noise(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    shares = [metrics.at(f"graph.coverage.{level}")[0] for level in _LEVELS]
    if None not in shares:
        holds = all(share > level / 100 - _NOISE_POINTS for share, level in zip(shares, _LEVELS))
        told = ", ".join(f"{100 * share:.0f}" for share in shares)
        numbers = f"{told} % of its measurements lie inside their 50, 90, 95 % bounds"
        yield holds, f"its stated noise {'holds' if holds else 'is too small'}: {numbers}"


def _rest(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    if doubled := sum(each.last - each.first + 1 for each in metrics.sequence.doubled or ()):
        yield False, f"{_count(doubled, 'frame')} repeat the one before while the camera moves"
    if (maps := metrics.tracking.maps or 1) > 1:
        events = metrics.tracking.events or ()
        lost = ", ".join(str(each.frame) for each in events if each.frame and "begun" in each.event)
        yield (
            False,
            f"tracking was lost{f' at frames {lost}' if lost else ''}: {maps} maps are not joined",
        )
    if metrics.provenance.leak is True:
        yield False, "LEAK: its weights saw this sequence, or a part of it, in training"
    if (off := metrics.map.accuracy_median_m) is not None:
        yield True, f"its map lies {off:.2g} m (median) from the true surface"


def _scraps(metrics: Metrics) -> str:
    """What is wrong with a map of which too little was fused; empty of a whole one, or without a map."""
    frames, filters = metrics.map.frames_fused, metrics.map.filters
    if not frames or not filters:
        return ""
    fused = (1.0 - sum(filters.values())) * frames / (frames + (metrics.map.frames_left_out or 0))
    if fused >= _LEAST_FUSED:
        return ""
    most = max(filters, key=filters.__getitem__)
    return (
        f"its map is scraps: {percent(fused)} of the depth of its keyframes was good enough to fuse, 35 to 60 % is "
        f"usual; most was left out by the filter {most} ({percent(filters[most])})"
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
