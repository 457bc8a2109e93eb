"""A run as a recording for the rerun viewer: images and depth along the drive, trajectories, the map."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics
from slam.pipeline.estimate import Estimate
from slam.runtime.errors import EmptyMapError
from slam.runtime.files import write_atomically
from slam.runtime.imports import import_extra

_COLOURS = {"reference": (120, 120, 120), "odometry": (240, 150, 40), "optimised": (40, 110, 240)}
_JPEG_QUALITY = 85
_POINT_VOXELS = 0.25  # radius of a map point in voxels


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
