"""A run in the rerun viewer: its recording, and what a live run shows while it lasts.

A recording has images and depth along the drive, trajectories and the map.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics
from slam.frontend.measured import Measured
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.live import LivePose
from slam.runtime.errors import EmptyMapError
from slam.runtime.files import write_atomically
from slam.runtime.imports import import_extra

_COLOURS = {"reference": (120, 120, 120), "odometry": (240, 150, 40), "optimised": (40, 110, 240)}
_JPEG_QUALITY = 85
_POINT_VOXELS = 0.25  # radius of a map point in voxels
_EVERY = 6  # pixel of the depth map, and frame, whose points are shown live
_PATH = (40, 110, 240)  # colour of the path while a run lasts


def write_rerun(path: Path, result: Estimate, intrinsics: Intrinsics) -> None:
    """Write ``.rrd``: on the timeline ``frame`` the camera with image and depth, over all time trajectories and map.

    The world is that of the optimised trajectory, y down. Images, of these ``intrinsics``, and depth, in the unit of
    the trajectory, are those of keyframes, thinned.

    Raises:
        SlamError: the extra ``rerun`` is not installed.
    """
    (rr,) = import_extra("rerun")
    keyframes = {keyframe.index: keyframe for keyframe in result.drive.keyframes}

    def fill(partial: Path) -> None:
        stream = rr.RecordingStream("erfsfm-slam")
        stream.save(str(partial))
        stream.log("world", rr.ViewCoordinates.RDF, static=True)
        for name, colour in _COLOURS.items():
            trajectory: Trajectory | None = getattr(result, name)
            if trajectory is not None:
                strip = rr.LineStrips3D([trajectory.positions], colors=[colour])
                stream.log(f"world/{name}", strip, static=True)
        for index, T_world_camera in enumerate(result.optimised.T_world_camera):
            stream.set_time("frame", sequence=index)
            stream.set_time("time", duration=float(result.optimised.stamps[index]))
            pose = rr.Transform3D(translation=T_world_camera[:3, 3], mat3x3=T_world_camera[:3, :3])
            stream.log("world/camera", pose)
            if index in keyframes:
                depth = np.nan_to_num(
                    keyframes[index].depth_unscaled * np.float32(result.scale.per_frame[index])
                )
                height, width = depth.shape
                K = intrinsics.resized(width, height).K
                stream.log(
                    "world/camera/image",
                    rr.Pinhole(image_from_camera=K, width=width, height=height),
                )
                image = rr.Image(keyframes[index].image).compress(jpeg_quality=_JPEG_QUALITY)
                stream.log("world/camera/image", image)
                stream.log("world/camera/image/depth", rr.DepthImage(depth, meter=1.0))
        if result.map is not None:
            with suppress(EmptyMapError):  # which the run has reported
                cloud = result.map.cloud()
                radii = _POINT_VOXELS * result.map.voxel_size
                points = rr.Points3D(cloud.points, colors=cloud.colours, radii=radii)
                stream.log("world/map", points, static=True)
        stream.flush()
        stream.disconnect()

    write_atomically(path, fill)


class Viewer:
    """Opens the viewer; it is shown what the drive has while it lasts."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        """Start it; ``SlamError`` where rerun is not installed."""
        (self._rr,) = import_extra("rerun")
        self._intrinsics = intrinsics
        self._positions: list[FloatArray] = []
        self._stream = self._rr.RecordingStream("erfsfm-slam live")
        self._stream.spawn()
        self._stream.log("world", self._rr.ViewCoordinates.RDF, static=True)

    def show(self, index: int, measured: Measured, newest: LivePose) -> None:
        """A frame at its pose; its image and depth where it is a keyframe."""
        rr, stream, T = self._rr, self._stream, newest.T_world_camera
        stream.set_time("frame", sequence=index)
        self._positions.append(T[:3, 3])
        stream.log(
            "world/path", rr.LineStrips3D([np.array(self._positions[-2000:])], colors=[_PATH])
        )
        stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        keyframe = measured.keyframes[-1] if measured.keyframes else None
        if keyframe is None or index - keyframe.index > 1 or newest.unit is None:
            return
        image, depth = keyframe.image, newest.unit * keyframe.depth_unscaled
        height, width = depth.shape
        camera = self._intrinsics.resized(width, height)
        pinhole = rr.Pinhole(image_from_camera=camera.K, width=width, height=height)
        stream.log("world/camera/image", pinhole, rr.Image(image).compress(jpeg_quality=85))
        stream.log("depth", rr.DepthImage(depth))
        if index % _EVERY == 0:
            grid = np.s_[height // 3 :: _EVERY, ::_EVERY]
            near = depth[grid] < np.nanmedian(depth) * 2
            points = (camera.rays(camera.pixel_grid()[grid]) * depth[grid][..., None])[near]
            cloud = rr.Points3D(se3.apply(T, points), colors=image[grid][near])
            stream.log(f"world/map/{index}", cloud)

    def correct(self, trajectory: Trajectory) -> None:
        """The path of the whole drive, with its loops closed."""
        self._stream.log(
            "world/path", self._rr.LineStrips3D([trajectory.positions], colors=[(20, 160, 60)])
        )
        self._stream.flush()
