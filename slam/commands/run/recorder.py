"""The run folder of a run while it lasts: each result is on disk before the next stage begins."""

from __future__ import annotations

import json
import logging
from contextlib import suppress

from erfsfm.common.errors import explained
from erfsfm.common.progress import Progress, silent
from slam.config.sections import SlamConfig, dump_yaml
from slam.evaluation.map import double_wall_share
from slam.formats.ply import Ply
from slam.formats.trajectory import Trajectory
from slam.frames import Image
from slam.mapping.filters import KeyframeDepth
from slam.mapping.surface import MapSurface
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import Recorder, SlamPipeline
from slam.results.estimate_metrics import estimate_metrics, lidar_trajectory, timing_of
from slam.results.folder import RunFolder
from slam.results.metrics import MapMetrics, Metrics, Provenance
from slam.results.report.map_view import map_view
from slam.results.report.page import Picture, write_report
from slam.results.report.pictures import DepthPictures, loop_pictures
from slam.results.truth import DepthQuality, map_errors
from slam.runtime.errors import EmptyMapError, Failed, SlamError, attempt
from slam.runtime.run_files import CONFIG, GRAPH, LOOPS, MAP_CLOUD, MAP_MESH, PLACES
from slam.runtime.storage.files import from_anywhere

logger = logging.getLogger(__name__)

_BEGUN = "the run has not ended, or was killed before its trajectories were written"
_NO_KEYFRAMES = "no frame for the map has depth"


class FolderRecorder(Recorder):
    """Writes results to a folder as they come, and ``metrics.json`` at the begin, with the estimate, and at the end."""

    def __init__(
        self,
        folder: RunFolder,
        pipeline: SlamPipeline,
        settings: SlamConfig,
        provenance: Provenance,
        progress: Progress = silent,
    ) -> None:
        """Prepare to write what a pipeline gives."""
        self.folder, self.pipeline = folder, pipeline
        self._settings, self._provenance, self._progress = settings, provenance, progress
        self._metrics = Metrics(schema_=1, status="running", reason=_BEGUN, provenance=provenance)

    def begin(self) -> None:
        """The metrics and settings of a run that begins; the source of depth by its whole path."""
        self.folder.write_metrics(self._metrics)
        settings, (kind, colon, path) = self._settings, self._settings.depth.source.partition(":")
        if colon:
            depth = settings.depth.model_copy(update={"source": f"{kind}:{from_anywhere(path)}"})
            settings = settings.model_copy(update={"depth": depth})
        self.folder.write_text(CONFIG, dump_yaml(settings))

    def trajectory(self, name: str, trajectory: Trajectory) -> None:
        """On disk in both formats."""
        self.folder.write_trajectory(name, trajectory)

    def estimate(self, estimate: Estimate) -> None:
        """Trajectories by loops and graph, these, and places; all metrics but those of the map."""
        folder, sequence = self.folder, self.pipeline.sequence
        for name in ("odometry", "optimised"):
            folder.write_trajectory(name, getattr(estimate, name))
        lidar = lidar_trajectory(estimate)
        if lidar is not None:
            folder.write_trajectory("lidar", lidar)
        if not isinstance(estimate.graph, Failed):
            estimate.graph.write_g2o(folder.path / GRAPH)
        folder.write_text(LOOPS, json.dumps(estimate.loops.details(), indent=2, allow_nan=False))
        folder.write(PLACES, estimate.places(sequence.intrinsics).write)
        with estimate.stopwatch.stage("evaluation"):
            self._metrics = estimate_metrics(estimate, sequence, self._provenance, self._settings.gps.factors)
        folder.write_metrics(self._metrics)
        self._stopwatch = estimate.stopwatch
        self._quality = DepthQuality(sequence, estimate.scale.is_metric)
        self._depths = DepthPictures(len(sequence))

    def keyframe(self, keyframe: KeyframeDepth) -> None:
        """Compared with the truth, and drawn for the report."""
        self._depths.add(keyframe)
        with self._stopwatch.stage("evaluation"):
            self._quality.add(keyframe)

    def map(self, estimate: Estimate | Failed) -> None:
        """Merge the submaps, write mesh and cloud; without a map its metrics are the reason."""
        surface = self._surface(estimate)
        if isinstance(surface, Failed):
            self._metrics = self._metrics.changed(map=MapMetrics.unknown(surface.reason))
            return
        assert isinstance(estimate, Estimate) and estimate.map is not None
        self._progress("map files", 0, 1)
        with self._stopwatch.stage("mesh"):
            surface.write_mesh(self.folder.path / MAP_MESH)
            surface.write_cloud(self.folder.path / MAP_CLOUD)
        with self._stopwatch.stage("evaluation"):
            metric = estimate.scale.is_metric
            share = double_wall_share(surface.meshes()) if metric else Failed("lengths are not in metres")
            pieces = lambda: (Ply(piece).points for piece in surface.cloud_pieces())  # noqa: E731
            errors = map_errors(pieces, estimate, self.pipeline.sequence)
        self._progress("map files", 1, 1)
        sizes = estimate.map.statistics()
        found = MapMetrics.of(**sizes, double_wall_share=share, **errors.tree())
        self._metrics = self._metrics.changed(map=found)

    def _surface(self, estimate: Estimate | Failed) -> MapSurface | Failed:
        """The surface of the map, or why there is none."""
        if isinstance(estimate, Failed):
            return estimate
        if estimate.map is None:
            is_enabled = self._settings.mapping.enabled
            return Failed(_NO_KEYFRAMES if is_enabled else "fusion is switched off (mapping.enabled)")
        try:
            with self._stopwatch.stage("mesh"):
                return estimate.map.surface(self._progress)
        except EmptyMapError as error:
            logger.warning("no map: %s", error)
            return Failed(str(error))

    def finish(self, estimate: Estimate) -> None:
        """The report and all metrics of a whole run."""
        sequence, output = self.pipeline.sequence, self._settings.output
        depth = self._quality.metrics(self._settings.depth.refine != "none")
        timing = timing_of(self._stopwatch, len(sequence))
        metrics = self._metrics.changed(status="ok", reason=None, timing=timing, depth=depth)

        def reported() -> None:
            if output.report:
                view = map_view(self.folder, output.viewer_triangles)
                write_report(self.folder, self._depths.pictures(), self._loop_pictures(estimate), view, metrics)

        self._progress("report", 0, 1)
        attempt("the report", reported)
        self.folder.write_metrics(metrics)
        self._progress("report", 1, 1)

    def fail(self, error: BaseException) -> str:
        """Write the reason of a failure, which is returned; errors of writing are ignored, for the first is raised."""
        reason = explained(error) if isinstance(error, Exception) else str(error) or type(error).__name__
        with suppress(SlamError, OSError):
            self.folder.write_metrics(self._metrics.changed(status="failed", reason=reason))
            self.leave()
            if self._settings.output.report:
                write_report(self.folder)
        return reason

    def leave(self) -> None:
        """What a run that failed can give yet."""

    def _loop_pictures(self, estimate: Estimate) -> list[Picture]:
        """Images of accepted loops: of the recording, or of the keyframes of a live drive."""
        sequence = self.pipeline.sequence

        def image(index: int) -> Image | None:
            try:
                return sequence.frame(index).image
            except SlamError:
                return next((each.image for each in estimate.drive.keyframes if each.index == index), None)

        return loop_pictures(estimate.loops.accepted, image, sequence.intrinsics)
