"""What a live run shows while it lasts, in the rerun viewer."""

from __future__ import annotations

import numpy as np

from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics
from slam.frontend.drive import Drive
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.live import LivePose
from slam.runtime.imports import import_extra

_EVERY = 6  # pixel of the depth map, and frame, whose points are shown
_PATH = (40, 110, 240)


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

    def show(self, index: int, drive: Drive, newest: LivePose) -> None:
        """A frame at its pose; its image and depth where it is a keyframe."""
        rr, stream, T = self._rr, self._stream, newest.T_world_camera
        stream.set_time("frame", sequence=index)
        self._positions.append(T[:3, 3])
        stream.log(
            "world/path", rr.LineStrips3D([np.array(self._positions[-2000:])], colors=[_PATH])
        )
        stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        keyframe = drive.keyframes[-1] if drive.keyframes else None
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
