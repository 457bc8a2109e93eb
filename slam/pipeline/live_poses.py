"""Poses of the newest frames at a cost that does not grow with the drive."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from slam.config.sections import SlamConfig
from slam.frontend.completion import complete_drive
from slam.frontend.drive import LAST_STEPS, frame_support
from slam.frontend.factors import chain_odometry, make_factors
from slam.frontend.scale import Scale, find_scale, resolve_mode
from slam.geometry.se3 import FloatArray, compose, invert
from slam.pipeline.observer import Observer

_WINDOW, _UPDATE = 100, 10  # frames whose poses are solved again, and between two solutions
State = Literal["starting", "tracking", "bridged", "relocalised"]


@dataclass(frozen=True)
class LivePose:
    """A frame's pose ``(4, 4)``; ``unit`` is that of the pose over that of learned depth, None while unknown.

    ``support`` is the share of the corners that fit the motion to it; None of the first frame, and where a map of
    keyframes gives the pose.
    """

    frame: int
    T_world_camera: FloatArray
    state: State
    unit: float | None
    support: float | None


class LivePoses:
    """Poses from the measurements of the last 100 frames; older poses stay as they are.

    Lengths of all steps in this window are solved again every tenth frame, in between the newest step is scaled as
    the last one was. Where keyframes measure the camera, only their unit is solved again; where they have lost it, only
    what follows the last frame that they located.
    """

    def __init__(self, sources: int, camera_height_m: float | None, config: SlamConfig) -> None:
        """Prepare for the first frame, by the ``sources`` of a snippet and the camera's height, None where unknown."""
        self._sources, self._camera_height_m = sources, camera_height_m
        self._mode = resolve_mode(config.scale, camera_height_m)
        self.unit_name: str | None = None  # of all lengths, None while unknown
        self._T_world_camera: list[FloatArray] = []
        self._unit: float | None = None  # of the mode per unscaled length, at the newest frame
        self._was_bridged = False
        self._settled = 0  # the last frame whose pose is by keyframes, or by the whole drive

    @property
    def T_world_camera(self) -> FloatArray:
        """Poses of all frames ``(N, 4, 4)``, at one place before the first snippet, while there is no unit."""
        T_world_camera = np.array(self._T_world_camera).reshape(-1, 4, 4)
        if self._unit is None:
            T_world_camera[:, :3, 3] = 0.0
        return T_world_camera

    @property
    def unit(self) -> float:
        """Of the poses over that of learned depth, at the newest frame; 1 while unknown."""
        return self._unit or 1.0

    def add(self, observer: Observer) -> list[LivePose]:
        """The frames that the observer has finished since the last call."""
        drive = observer.drive
        first, count = len(self._T_world_camera), len(drive)
        frames = range(first, count)
        unasked = {0, *(index for index in frames if self._step(observer, index))}
        if drive.snippets and (self._unit is None or count // _UPDATE > first // _UPDATE):
            self._solve(observer, count)
        unit = None if self.unit_name is None else self._unit
        support = frame_support(frames, drive.motions[-LAST_STEPS * len(frames) :]).tolist()
        return [
            LivePose(k, pose.copy(), self._state(k in drive.unusable), unit, None if k in unasked else share)
            for k, pose, share in zip(frames, self._T_world_camera[first:], support)
        ]

    def correct(self, T_world_camera: FloatArray, scale: Scale) -> None:
        """Go on from the poses ``(N, 4, 4)`` and the unit of a whole drive."""
        self._T_world_camera, self._unit = list(T_world_camera), float(scale.per_frame[-1])
        self.unit_name = scale.unit_name
        self._settled = max(len(T_world_camera) - 1, 0)

    def _state(self, is_bridged: bool) -> State:
        before, self._was_bridged = self._was_bridged, is_bridged
        if self.unit_name is None:
            return "starting"
        return "bridged" if is_bridged else "relocalised" if before else "tracking"

    def _step(self, observer: Observer, index: int) -> bool:
        """Append the pose of a frame by its own step, or by the last one again; whether a map has it."""
        if not index:
            self._T_world_camera.append(np.eye(4))
            return False
        before, by_keyframes, motion = index - 1, observer.keyframes.step(index), observer.drive.last_step(index)
        T_before_frame = None
        if by_keyframes is not None:
            before, T_before_frame = by_keyframes
            self._settled = index
        elif motion is not None and motion.ends[0] == before:
            T_before_frame = motion.relative_pose.T_from_to.copy()
        if T_before_frame is not None:
            T_before_frame[:3, 3] *= self.unit
        else:  # the camera goes on as it went
            T_before_frame = invert(self._T_world_camera[max(before - 1, 0)]) @ self._T_world_camera[before]
        self._T_world_camera.append(compose(self._T_world_camera[before], T_before_frame))
        return by_keyframes is not None

    def _solve(self, observer: Observer, count: int) -> None:
        """Poses of the window by its own measurements, from its first one on, or from the last settled one on."""
        first = max(count - _WINDOW, 0)
        window = observer.drive.since(first)
        if not window.snippets:
            return
        by_keyframes = observer.keyframes.step(count - 1) is not None
        # keyframes know all lengths but their unit, which learned depth of the ground gives
        roads_alone = replace(window, motions=[], road_steps={})
        window = roads_alone if by_keyframes else complete_drive(window, self._sources)
        scale = find_scale(self._mode, self._camera_height_m, window, [])
        self.unit_name = scale.unit_name
        unit = float(np.median(scale.per_frame) if by_keyframes else scale.per_frame[-1])
        if self._unit is None:
            for T in self._T_world_camera:
                T[:3, 3] *= unit
        self._unit = unit
        if by_keyframes:
            return
        T_odometry = chain_odometry(make_factors(window, scale, level=logging.DEBUG), len(window))
        kept = max(first, self._settled)
        T_window_camera = T_odometry[kept - first :]
        T_world_window = self._T_world_camera[kept] @ invert(T_window_camera[0])
        self._T_world_camera[kept + 1 :] = list(T_world_window @ T_window_camera[1:])
