"""One run from start to end: sequence and weights in, a run folder out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from erfsfm import __version__
from erfsfm.errors import ErfsfmError
from erfsfm.evaluation.pose_metrics import (
    SnippetErrors,
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
from erfsfm.inference import DepthPosePredictor, commit
from slam import frontend, loops, se3
from slam.cache import CachedNetworks
from slam.config import dump_yaml, load_config
from slam.errors import SlamError
from slam.evaluation import trajectory_metrics
from slam.foreign import import_rerun
from slam.frames import Intrinsics
from slam.frames import Sequence as FrameSequence
from slam.frontend.refusal import Refusal
from slam.map_metrics import accuracy_median_m, completeness, pose_similarity, visible_surface
from slam.memory import Memory, Recollection, compute_anew, fingerprint
from slam.networks import NetworkPredictor
from slam.pipeline import Progress, SlamPipeline, SlamResult
from slam.places import PLACES, Places
from slam.pose_graph import coverage, coverage_by_source
from slam.report import DepthExample, write_report
from slam.rerun_file import write_rerun
from slam.run_folder import RunFolder
from slam.se3 import apply, umeyama
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import Excerpt
from slam.summary import (
    SCHEMA,
    Provenance,
    as_json,
    describe_bridged,
    describe_failure,
    describe_sequence,
    describe_timing,
    finite,
    null,
)
from slam.threads import one_thread_each
from slam.trajectory import Trajectory

logger = logging.getLogger(__name__)


def run_slam(
    dataset: str | Path | None = None,
    sequence: str | None = None,
    camera: Path | None = None,
    weights: str | Path = "default",
    config: str | Path | None = None,
    overrides: Sequence[str] = (),
    frames: str | None = None,
    output: Path | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: Progress | None = None,
    command: str = "slam.run_slam",
    cache: Path | None = None,
    rerun: Path | None = None,
) -> RunFolder:
    """Run the whole system on one sequence.

    Args:
        dataset: KITTI odometry root, KITTI raw drive, TUM folder, image folder or video; None with no
            ``sequence`` is the embedded simulated street.
        sequence: name inside the data set.
        camera: ``camera.yaml`` of a folder or video, where none lies beside it.
        weights: a shipped name or a training output folder.
        config: a YAML file or a shipped name; None for the defaults.
        overrides: ``section.key=value`` each.
        frames: ``A:B``, half-open.
        output: the run folder itself; None makes ``results/<stamp>_<sequence>``.
        seed: of everything random.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: told of (stage, done, total).
        command: recorded in the metrics.
        cache: folder that keeps the networks' answers and what images alone determine; None asks anew.
        rerun: ``.rrd`` file to write for the rerun viewer, an optional extra.

    Returns:
        The run folder.

    Raises:
        SlamError, ErfsfmError: one line; whatever ends a run, a folder already made holds what there is and says why.
    """
    if rerun is not None:
        import_rerun()  # better missed before the run than after it
    settings = load_config(config, overrides)
    recording = open_sequence(Path(dataset) if dataset is not None else None, sequence, camera, frames)
    networks = DepthPosePredictor.from_weights(weights, device).freeze()
    memory = None if cache is None else Memory(cache)
    predictor = NetworkPredictor(networks if memory is None else _cached(networks, memory))
    recall = compute_anew if memory is None else Recollection(memory, _code()).recall
    provenance = Provenance(
        version=__version__,
        commit=commit(),
        command=command,
        seed=seed,
        device=str(networks.device),
        weights=str(weights),
        weights_sha256=networks.sha256,
        weights_licence=networks.record.licence,
        trained_on=networks.record.trained_on,
        leak=bool(networks.leaks(recording.provenance())),
    )
    folder = RunFolder.create(output, Path(settings.output.root), recording.name)
    folder.write_text("config.yaml", dump_yaml(settings))
    with _logging_to(folder.path / "run.log"):
        try:
            _seed(seed)
            pipeline = SlamPipeline(recording, predictor, settings, progress, networks.noise, recall)
            with one_thread_each():
                result = _run(folder, pipeline, recording, provenance, settings.output.report)
            if rerun is not None:
                write_rerun(rerun, result, recording.intrinsics, settings.mapping.voxel_size_m)
            return folder
        except BaseException as error:
            _leave_failure(folder, provenance, settings.output.report, error)
            raise


def _leave_failure(folder: RunFolder, provenance: Provenance, report: bool, error: BaseException) -> None:
    """Say in the folder why the run ended; where even that fails, the first error is the one to hear about."""
    known = isinstance(error, SlamError | ErfsfmError)
    reason = str(error) if known else " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    logger.error("the run failed: %s", reason)
    with suppress(SlamError):
        folder.write_metrics(describe_failure(provenance, reason))
        if report:
            write_report(folder, [], None, None)


def _cached(networks: DepthPosePredictor, memory: Memory) -> CachedNetworks:
    """The networks with a memory of their answers; GPU and CPU answer a little differently and share none."""
    network = networks.record.network.model_dump_json()
    return CachedNetworks(networks, f"{networks.sha256} {network} {networks.device.type}", memory)


def _code() -> str:
    """Whatever measures images: an entry names it, so that there is no version to forget."""
    folders = (Path(package.__path__[0]) for package in (frontend, loops))
    sources = [path for folder in folders for path in sorted(folder.glob("*.py"))]
    versions = (f"{library.__name__} {library.__version__}" for library in (np, cv2, scipy))
    return " ".join((fingerprint(*sources, Path(se3.__file__)), *versions))


def _seed(seed: int) -> None:
    np.random.seed(seed)
    cv2.setRNGSeed(seed)


def _run(
    folder: RunFolder, pipeline: SlamPipeline, sequence: FrameSequence, provenance: Provenance, report: bool
) -> SlamResult:
    estimate = pipeline.estimate()
    _write_estimate(folder, estimate, sequence.intrinsics)
    result = replace(estimate, map=pipeline.fuse(estimate))
    surface = _write_map(folder, result, sequence)
    folder.write_metrics(_metrics(result, sequence, provenance, surface.summary))
    if report:
        examples = [DepthExample(i, image, depth) for i, image, depth in result.observations.examples]
        write_report(folder, examples, surface.points, surface.colours)
    return result


def _write_estimate(folder: RunFolder, result: SlamResult, intrinsics: Intrinsics) -> None:
    """Trajectories, graph, loops and places: kept even where the map fails."""
    for name in ("network", "odometry", "optimised"):
        folder.write_trajectory(f"trajectory_{name}", getattr(result, name))
    if result.reference is not None:
        folder.write_trajectory("reference", result.reference)
    lidar = _lidar_trajectory(result)
    if lidar is not None:
        folder.write_trajectory("trajectory_lidar", lidar)
    folder.write("graph.g2o", result.graph.write_g2o)
    folder.write_text("loops.json", as_json(result.loops.details()))
    folder.write(PLACES, _places(result, intrinsics).write)


def _places(result: SlamResult, intrinsics: Intrinsics) -> Places:
    """The camera, and every view with its points, in the unit and at the poses of the optimised trajectory."""
    views = tuple(view.scaled(float(result.scale.per_frame[view.index])) for view in result.observations.views)
    T_world_camera = result.optimised.T_world_camera[np.array([view.index for view in views], dtype=np.intp)]
    return Places(intrinsics, views, T_world_camera)


def _lidar_trajectory(result: SlamResult) -> Trajectory | None:
    """The LiDAR's path with the stamps of its frames."""
    if result.lidar is None:
        return None
    return Trajectory(result.optimised.stamps[result.lidar.frames], result.lidar.T_world_camera)


def _lidar_metrics(result: SlamResult) -> dict[str, Any]:
    """Errors of the LiDAR's path against the truth at its own frames."""
    lidar = _lidar_trajectory(result)
    if lidar is None or result.lidar is None:
        return null("lidar", "the sequence has no LiDAR scans")
    reference = None if result.reference is None else result.reference.select(result.lidar.frames).rebased()
    return {"lidar": trajectory_metrics(lidar, reference)}


def _metrics(
    result: SlamResult, sequence: FrameSequence, provenance: Provenance, map_summary: dict[str, Any]
) -> dict[str, Any]:
    reference = result.reference
    trajectories = {
        "network": trajectory_metrics(result.network, reference, _network_snippets(result)),
        "odometry": trajectory_metrics(result.odometry, reference),
        "optimised": trajectory_metrics(result.optimised, reference),
        **_lidar_metrics(result),
    }
    metrics: dict[str, Any] = finite(
        {
            "schema": SCHEMA,
            "status": "ok",
            "provenance": asdict(provenance),
            "sequence": describe_sequence(sequence, reference.length_m if reference is not None else None)
            | describe_bridged(result.observations.bridged),
            "timing": describe_timing(result.stopwatch, len(sequence)),
            "scale": _scale(result),
            "trajectories": trajectories,
            "graph": _graph(result),
            "loops": result.loops.summary(),
            "map": map_summary,
        }
    )
    return metrics


def _network_snippets(result: SlamResult) -> SnippetErrors | None:
    """The paper's protocol on the network's direct answers; None without truth or with other snippets."""
    snippets = result.observations.snippets
    if result.reference is None or len(snippets[0].sources) != 4:
        return None
    predicted = np.stack([snippet_from_network(s.T_source_target) for s in snippets])
    return snippet_errors(predicted, snippets_from_trajectory(result.reference.T_world_camera))


def _scale(result: SlamResult) -> dict[str, Any]:
    estimate = result.scale.estimate
    if isinstance(estimate, Refusal):
        return {"mode": result.scale.mode, **null("value", estimate.reason)}
    return {
        "mode": result.scale.mode,
        "value": estimate.value,
        "spread": estimate.spread,
        "frames_used": estimate.frames_used,
    }


def _graph(result: SlamResult) -> dict[str, Any]:
    """Size of the graph, and whether its noise means what it says: truth brought to the graph's scale."""
    summary: dict[str, Any] = {"nodes": len(result.optimised), "factors": len(result.graph.relative_poses)}
    if result.reference is None:
        return summary | null("coverage", "the sequence has no true poses")
    aligned = umeyama(result.optimised.positions, result.reference.positions, with_scale=True)
    if not aligned.scale > 0:
        return summary | null("coverage", "the estimate does not move: the truth cannot be brought to its scale")
    compared = (result.graph.relative_poses, result.reference.T_world_camera, aligned.scale)
    return summary | {"coverage": coverage(*compared), "coverage_by_source": coverage_by_source(*compared)}


@dataclass(frozen=True)
class _Surface:
    """The map as points for the report, and its numbers."""

    summary: dict[str, Any]
    points: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


def _write_map(folder: RunFolder, result: SlamResult, sequence: FrameSequence) -> _Surface:
    if result.map is None:
        return _Surface(_no_map("fusion is switched off (mapping.enabled)"))
    try:
        folder.write("map_mesh.ply", result.map.write_mesh)
        folder.write("map_cloud.ply", result.map.write_cloud)
    except SlamError as error:
        logger.warning("no map: %s", error)
        return _Surface(_no_map(str(error)))
    cloud = result.map.cloud()
    quality = _map_quality(cloud.points_world, result, sequence)
    return _Surface(asdict(result.map.statistics()) | quality, cloud.points_world, cloud.colours)


def _no_map(reason: str) -> dict[str, Any]:
    names = ("triangles", "points", "blocks", "accuracy_median_m", "completeness")
    return {key: value for name in names for key, value in null(name, reason).items()}


def _map_quality(points: NDArray[np.float64], result: SlamResult, sequence: FrameSequence) -> dict[str, Any]:
    """Distance to the true street and share of it found, the map moved with its trajectory to the truth."""
    base, first = (sequence.base, sequence.start) if isinstance(sequence, Excerpt) else (sequence, 0)
    street = getattr(base, "street", None)
    if result.reference is None or street is None:
        reason = "the true surface is known for the embedded simulated sequence only"
        return null("accuracy_median_m", reason) | null("completeness", reason)
    to_truth = pose_similarity(result.reference.T_world_camera, result.optimised.T_world_camera)
    T_street_first = street.T_world_camera[first]
    points_true = apply(T_street_first, to_truth.scale * points @ to_truth.R_a_b.T + to_truth.t_a_b)
    seen = [
        visible_surface(street.render(k).depth, sequence.intrinsics.K, street.T_world_camera[k], step=8)
        for k in range(first, first + len(sequence), 10)
    ]
    rng = np.random.default_rng(0)
    sample = points_true[rng.permutation(len(points_true))[:20_000]]
    return {
        "accuracy_median_m": accuracy_median_m(sample, street.distance_to_surface),
        "completeness": completeness(np.concatenate(seen), points_true),
    }


@contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    """Send the package's log to a file, line by line, beside wherever it goes already."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger("slam")
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(level)
        handler.close()
