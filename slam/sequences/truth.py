"""True poses of a recording from a file of the user."""

from __future__ import annotations

from pathlib import Path

from slam.formats.trajectory import other_unit, read_trajectory
from slam.runtime.errors import SequenceError
from slam.sequences.poses import known_poses, poses_near
from slam.sequences.recording import RecordedSequence


def take_truth(recording: object, path: Path) -> None:
    """Let a recording have the camera poses of a KITTI or TUM file as its truth; they are in metres, in any world.

    Rows with stamps belong to the frames of these times, rows with frame numbers to these frames, and others to the
    frames one by one.

    Raises:
        SequenceError: the rows are not of its frames, or its loader makes no `RecordedSequence`.
        TrajectoryError: the file cannot be read.
    """
    if not isinstance(recording, RecordedSequence):
        raise SequenceError(f"the loader of this recording takes no true poses: leave out --truth {path}")
    truth, frames = read_trajectory(path), len(recording)
    numbers = truth.frame_numbers
    if truth.timed:
        T_any_camera = poses_near(truth.T_world_camera, truth.stamps, recording.stamps, path)
    elif truth.numbered or truth.frame_count == frames:
        of_frame = (numbers >= 0) & (numbers < frames)
        known = recording.stamps[numbers[of_frame]]
        T_any_camera = poses_near(truth.T_world_camera[of_frame], known, recording.stamps, path)
    else:
        raise SequenceError(
            f"--truth {path} has {truth.frame_count} rows and the recording {frames} frames: give each frame a row, "
            "or rows with stamps (TUM)"
        )
    cure = other_unit(truth.stamps, recording.stamps) if truth.timed else None
    if cure or not known_poses(T_any_camera).any():
        its, ours = (f"{numbers[0]:.3f} to {numbers[-1]:.3f}" for numbers in (truth.stamps, recording.stamps))
        raise SequenceError(
            f"--truth {path} covers {its} and the recording {ours}: {cure or 'bring both to the same clock'}"
        )
    recording.take_truth(T_any_camera)


def poses_beside(recording: Path) -> Path | None:
    """A file ``poses*.txt`` in or beside a recording; nothing tells whose poses they are."""
    places = (recording, recording.absolute().parent) if recording.is_dir() else (recording.absolute().parent,)
    return next((path for place in places for path in sorted(place.glob("poses*.txt"))), None)
