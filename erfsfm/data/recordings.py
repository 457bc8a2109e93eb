"""A training recording: consecutive frames, their camera, and ground truth where it is known.

Images are decoded on demand.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import Image, read_depth_map, read_image, resize_image
from erfsfm.common.readers.numbering import NumberedFiles
from erfsfm.common.readers.video import VideoFrames
from erfsfm.config import Fidelity, NetworkConfig
from erfsfm.geometry import Camera

logger = logging.getLogger(__name__)

_LEAST_DETERMINANT = 0.5  # of what a file has for rotations
_WHITE = 250  # grey levels of a resized mask: black ones spread into their neighbours
_kept: dict[
    Path, Image
] = {}  # of this process: the frames ``(N, height, width, 3)`` of each video at one size


class Video:
    """A video file with random access to downscaled frames.

    Training reads frames in any order, and a seek in compressed video is slow. Hence the first access decodes the file
    from its beginning to its end, and all frames are kept, downscaled, in a temporary file that the system pages in and
    out: 160 kB a frame at 416x128. Each process has its own, which a video that is sent to it does not carry.
    """

    def __init__(self, path: Path) -> None:
        """Count the frames, which takes one pass: what the file announces may be wrong."""
        self.path = path
        frames = VideoFrames(path, counted_frames=sys.maxsize)
        self._length = len(frames)
        self.height, self.width = frames.height, frames.width
        _kept.pop(path, None)  # of a file that lay there before

    def __len__(self) -> int:
        return self._length

    def image(self, index: int, height: int, width: int) -> Image:
        """One frame ``(height, width, 3)`` uint8 RGB, resized without crop."""
        frames = _kept.get(self.path)
        if frames is None or frames.shape[1:3] != (height, width):
            decoded = VideoFrames(self.path, counted_frames=0)
            with tempfile.TemporaryFile(prefix="erfsfm-video-") as file:
                for number in range(self._length):
                    file.write(resize_image(decoded.read(number), height, width).tobytes())
                file.flush()
                frames = np.memmap(file, np.uint8, "r", shape=(self._length, height, width, 3))
            _kept[self.path] = frames
        return np.array(frames[index])


@dataclass(frozen=True)
class Recording:
    """Frames of one drive: ``images`` are their files; of a ``video`` each is the video file.

    ``camera`` belongs to the images as stored. ``start`` is the number of the first frame, by which the files beside
    the images are indexed. ``depth``, perhaps of some frames alone, and ``poses_file`` are ground truth where it is
    known, and so is ``camera_height_m``, the unit of depth in a simulated world: above the road, in rooms a constant.
    The poses are of camera 0, which lies at ``t_camera_cam0`` in this camera's frame. ``sequence`` is the name of its
    folder in an odometry root, ``oxts`` the folder of the GPS/IMU's packets, one a frame. For a part of a recording
    with gaps, ``skipped`` images come before it and there are ``stored`` in all; pose files may have rows for these
    alone. Of one in a prepared folder, ``labels`` is where the teacher's measurements are, and ``without_stops`` says
    that frames in which the car stands still were taken out before. The frames are every ``stride``-th one from
    ``start``. ``mask`` is black where the images show what is fixed to the camera.
    """

    name: str
    images: tuple[Path, ...]
    camera: Camera
    video: Video | None = None
    depth: tuple[Path | None, ...] | None = None
    depth_per_metre: float = 256.0  # KITTI's
    poses_file: Path | None = None
    camera_height_m: float | None = None
    t_camera_cam0: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: int = 0
    sequence: str = ""
    oxts: Path | None = None
    skipped: int = 0
    stored: int = 0
    without_stops: bool = False
    stride: int = 1
    labels: Path | None = None
    mask: Path | None = None

    def __len__(self) -> int:
        return len(self.images)

    @property
    def frames_name(self) -> str:
        """The name with its frames, as the leak record writes it: ``kitti_odometry/00[0:250]``."""
        return f"{self.name}[{self.start}:{self.number(len(self))}]"

    def number(self, index: int) -> int:
        """The number that a frame has in the stored recording."""
        return self.start + self.stride * index

    def every(self, n: int) -> Recording:
        """Every n-th frame, without what is known of them."""
        return replace(self, images=self.images[::n], depth=None, stride=n * self.stride)

    @property
    def key(self) -> tuple[str, Path]:
        """Its frames in any process, and where they are."""
        return self.frames_name, self.images[0]

    def part(self, start: int, stop: int) -> Recording:
        """Frames ``start`` to ``stop - 1`` of this recording, counted from its own first."""
        return replace(
            self,
            images=self.images[start:stop],
            depth=self.depth[start:stop] if self.depth else None,
            start=self.number(start),
            skipped=self.skipped + start,
        )

    def within(self, first: int, stop: int) -> Recording | None:
        """The frames with the numbers ``first`` to ``stop - 1``; None if there are none."""
        begin, end = max(first - self.start, 0), min(stop - self.start, len(self))
        return self.part(begin, end) if begin < end else None

    def image(self, index: int, height: int, width: int) -> NDArray[np.uint8]:
        """Frame as ``(height, width, 3)`` uint8 RGB, resized without crop; ``DataError`` where it cannot be read."""
        stored = self.images[index]
        if self.video is not None:
            self._require_size(stored, self.video.height, self.video.width)
            return self.video.image(self.number(index), height, width)
        image = read_image(stored)
        self._require_size(stored, *image.shape[:2])
        return resize_image(image, height, width)

    def seen_by(self, network: NetworkConfig) -> Camera:
        """The camera of images at a network's size."""
        return self.camera.resized(network.width, network.height, network.fidelity)

    def fixed(self, height: int, width: int) -> NDArray[np.bool_]:
        """Where the images, resized, show what is fixed to the camera ``(height, width)``; nowhere without a mask."""
        if self.mask is None:
            return np.zeros((height, width), np.bool_)
        mask = read_image(self.mask)
        self._require_size(self.mask, *mask.shape[:2])
        return resize_image(mask, height, width)[..., 0] < _WHITE

    @property
    def exact(self) -> bool:
        """Whether all depth is known, in camera heights too: that of a simulated world with depth maps."""
        return (
            self.camera_height_m is not None and self.depth is not None and None not in self.depth
        )

    def true_depth(self, index: int) -> NDArray[np.float32] | None:
        """z-depth in metres ``(H, W)``, 0 where unknown; None where the frame has no depth."""
        path = None if self.depth is None else self.depth[index]
        return (
            None if path is None else read_depth_map(path, self.depth_per_metre).astype(np.float32)
        )

    def shrunk_depth(self, index: int, height: int, width: int) -> NDArray[np.float32]:
        """As `true_depth` of a frame that has it, by the nearest pixels at another size, of ``image`` as a rule."""
        depth_m = self.true_depth(index)
        assert depth_m is not None, "the frame has depth"
        return cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)

    def true_poses(self, fidelity: Fidelity = "default") -> NDArray[np.float64] | None:
        """``T_world_camera`` ``(N, 4, 4)``, or None where the recording has no poses.

        In ``paper`` fidelity those of camera 0, as the reference compares with.

        Raises:
            DataError: the file holds no poses, or ends before the recording.
        """
        if self.poses_file is None:
            return None
        try:
            numbers = np.loadtxt(self.poses_file, ndmin=2)
            if numbers.shape[1] != 12 or not np.isfinite(numbers).all():
                raise ValueError(
                    f"it has {numbers.shape[1]} columns, or a number that is not finite"
                )
            rows = numbers.reshape(-1, 3, 4)
            if (np.linalg.det(rows[..., :3]) < _LEAST_DETERMINANT).any():
                raise ValueError("its columns 1-3, 5-7 and 9-11 are no rotation")
        except (OSError, ValueError) as error:
            raise DataError(f"{self.poses_file} must hold 12 numbers a row: {error}") from error
        first = self.skipped if len(rows) == self.stored else self.start
        rows = rows[first : first + len(self)]
        if len(rows) < len(self):
            raise DataError(
                f"{self.poses_file} ends before frame {self.start + len(self)} of {self.name}"
            )
        T_world_camera = np.tile(np.eye(4), (len(rows), 1, 1))
        T_world_camera[:, :3] = rows
        if fidelity == "default":
            # the rectified cameras differ by a translation alone: t_cam0_camera = -t_camera_cam0
            T_world_camera[:, :3, 3] -= T_world_camera[:, :3, :3] @ np.array(self.t_camera_cam0)
        return T_world_camera

    def _require_size(self, stored: Path, height: int, width: int) -> None:
        if (height, width) != (self.camera.height, self.camera.width):
            raise DataError(
                f"{stored} is {width} x {height}; the camera of {self.name} is {self.camera.width} x "
                f"{self.camera.height}; all images of a recording need one size"
            )


def split_at_gaps(whole: Recording, files: NumberedFiles) -> list[Recording]:
    """The parts of a recording between missing frame numbers, each with the numbers of its files."""
    if files.gaps():
        logger.warning(
            "%s: %s; split into %d parts",
            files.paths[0].parent,
            files.describe_gaps(),
            len(files.parts()),
        )
    parts = []
    for begin, end in files.parts():
        start = files.first + files.rows[begin]
        parts.append(replace(whole.part(begin, end), start=start, stored=len(files.paths)))
    return parts
