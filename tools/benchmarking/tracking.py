"""How well a carried camera was followed: its error, losses and waits."""

from __future__ import annotations

import functools

import numpy as np
from benchmarking.runs import Job, JobResult

from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.sequences.catalogue import open_sequence
from slam.sequences.poses import known_poses
from slam.sequences.recording import RecordedSequence


@functools.cache
def error_and_path(job: Job) -> tuple[float | None, float | None]:
    """7-dof ATE of the optimised trajectory, and the path, by those frames whose true pose is known, metres."""
    drive = job.drive
    sequence = open_sequence(drive.root, drive.sequence or None, truth=drive.truth)
    poses = sequence.T_any_camera if isinstance(sequence, RecordedSequence) else None
    known = np.zeros(0, np.intp) if poses is None else np.flatnonzero(known_poses(poses))
    estimate = RunFolder(job.place).trajectory("optimised")
    if poses is None or estimate is None or not len(known):
        return None, None
    truth = Trajectory(sequence.stamps[known], poses[known]).rebased()
    ate: float | None = trajectory_metrics(
        estimate.select(known).rebased(), truth
    ).align.dof7.ate_rmse_m
    return ate, truth.length_m


def losses(o: JobResult) -> int | None:
    """How often the camera was lost."""
    events = o.metrics.tracking.events
    return None if events is None else sum(each.event == "lost" for each in events)


def first_map(o: JobResult) -> int | None:
    """Number of frames before the first map."""
    events = o.metrics.tracking.events or ()
    return next((each.frame for each in events if each.event == "map begun"), None)


def longest_wait(o: JobResult) -> int | None:
    """Most frames from a loss until the camera was found again, or a new map began, or the recording ended."""
    events, frames = o.metrics.tracking.events, o.metrics.sequence.frames
    if events is None or frames is None:
        return None
    lost = [each.frame for each in events if each.event == "lost"]
    found = [each.frame for each in events if each.event in ("map begun", "relocalised")]
    waits = []
    for start in lost:
        later = [frame for frame in found if frame > start]
        waits.append(min(later, default=frames) - start)
    return max(waits, default=None)
