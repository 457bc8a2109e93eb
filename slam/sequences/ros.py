"""Sequences of bags: each camera of a bag is one, named by its topic."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.images import first_usual, stretch_of
from slam.formats.rows import BadRows
from slam.formats.trajectory import nearest_pairs
from slam.frames import Image
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, invert
from slam.runtime.errors import SequenceError
from slam.sequences import bag as bags
from slam.sequences.bag import Bag, is_bag, is_rectified
from slam.sequences.camera_file import find_camera_file
from slam.sequences.images import ReadImages
from slam.sequences.loader import Asked, Loader, Openers
from slam.sequences.poses import poses_near, poses_of
from slam.sequences.recording import ArrayReaders, RecordedSequence, Source

logger = logging.getLogger(__name__)

_POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
_POSITIONS = ("sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/PointStamped")
_TRUTH = re.compile(
    r"truth|(?:^|[/_])gt(?:$|[/_])|vicon|mocap|optitrack|qualisys|natnet", re.IGNORECASE
)
_STATIC_TOPIC, _MOVING_TOPIC = "/tf_static", "/tf"
_MOST_OUT_OF_PLACE = 5  # messages, of one that was recorded late
_SOUGHT_IMAGES = 100  # one of which must be readable
_SKIPPED_FRAMES = 30
_SCAN_DELAY_S = 0.05
_NANOSECONDS = 10**9

Mounts = dict[str, tuple[str, FloatArray]]
"""Parent and ``T_parent_child`` ``(4, 4)`` of each frame of ``/tf_static``; the last that is said counts."""


class StampedMessages:
    """The messages of a topic whose first field is a header, in the order of their stamps, read one at a time.

    All messages are read once for their stamps. Where no header has a stamp, or their clock was set back, the times of
    recording are used; of messages with one stamp the first is kept.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self._bag, self.topic = bag, topic
        self._times_ns: list[int] = []
        stamps_ns = []
        for time_ns, data in bag.raw(topic):
            self._times_ns.append(time_ns)
            stamps_ns.append(bag.stamp_ns(topic, data))
        stamps = _seconds(stamps_ns if any(stamps_ns) else self._times_ns)
        numbers = np.arange(len(stamps))
        if (np.abs(np.argsort(stamps, kind="stable") - numbers) > _MOST_OUT_OF_PLACE).any():
            steps = np.diff(stamps)
            logger.warning(
                "%s: the stamps of its headers go back by %.2f s at message %d: the times of recording are used",
                topic,
                -steps.min(),
                int(steps.argmin()) + 1,
            )
            stamps = _seconds(self._times_ns)
        rows = BadRows(f"topic {topic} of {bag.path}", SequenceError)
        order = rows.in_order(stamps, "stamps", numbers + 1, "messages")
        self._numbers, self.stamps = order.tolist(), stamps[order]
        self._next = 0
        self._following: Iterator[tuple[int, bytes]] = iter(())

    def __len__(self) -> int:
        """Number of messages."""
        return len(self._numbers)

    def read(self, index: int) -> Any:
        """One message.

        Raises:
            SequenceError: the bag breaks off before it.
        """
        number = self._numbers[index]
        if not self._next <= number <= self._next + _SKIPPED_FRAMES or self._next == 0:
            time_ns = self._times_ns[number]
            self._next = self._times_ns.index(time_ns)
            self._following = self._bag.raw(self.topic, time_ns)
        position, self._next = self._next, 0  # after an error the next message is searched again
        for _, data in self._following:
            position += 1
            if position == number + 1:
                self._next = position
                return self._bag.parse(self.topic, data)
        raise SequenceError(
            f"{self._bag.path} breaks off at message {number} of {self.topic}: copy it again"
        )

    def points(self, index: int, where: str) -> FloatArray:
        """The points ``(P, 3)`` of a cloud, metres; ``where`` names it in errors."""
        return bags.points_of(self.read(index), where)


def _seconds(nanoseconds: list[int]) -> FloatArray:
    return np.array([each / _NANOSECONDS for each in nanoseconds])


def images_of(messages: StampedMessages, where: str) -> ReadImages:
    """The images of a topic, all of the size of the first readable ones; not for use from several threads.

    Args:
        messages: of a topic of images.
        where: its name, for errors.

    Raises:
        SequenceError: an image cannot be read; also later, where one has another size.
        DataError: no image can be decoded.
    """
    rows = range(len(messages))
    stretch = stretch_of(rows, lambda row: bags.values_of(messages.read(row), where))

    def decode(row: int) -> Image:
        return bags.image_of(messages.read(row), where, stretch)

    height, width = first_usual(rows[:_SOUGHT_IMAGES], decode)[1].shape[:2]

    def read(row: int) -> Image:
        image = decode(row)
        if image.shape[:2] != (height, width):
            raise SequenceError(
                f"{where} is {image.shape[1]}x{image.shape[0]}, the first are {width}x{height}"
            )
        return image

    return ReadImages(width, height, len(rows), read)


def transform_between(mounts: Mounts, a: str, b: str) -> FloatArray | None:
    """``T_a_b`` ``(4, 4)`` of two frames; None where no static transforms join them, or where one has no name."""
    names = [frame.removeprefix("/") for frame in (a, b)]  # ROS 1 may write a slash
    if not all(names):
        return None
    (root_a, T_root_a), (root_b, T_root_b) = (_from_root(mounts, name) for name in names)
    return invert(T_root_a) @ T_root_b if root_a == root_b else None


def _from_root(mounts: Mounts, frame: str) -> tuple[str, FloatArray]:
    T_root_frame, seen = np.eye(4), {frame}
    while frame in mounts:
        frame, T_parent_child = mounts[frame]
        if frame in seen:
            break  # a loop has no root
        seen.add(frame)
        T_root_frame = T_parent_child @ T_root_frame
    return frame, T_root_frame


def transforms(bag: Bag, topic: str) -> Iterator[tuple[str, str, float, FloatArray]]:
    """Parent, child, stamp in seconds and ``T_parent_child`` ``(4, 4)`` of the good transforms of a topic of tf."""
    for message in bag.messages(topic) if topic in bag.types else ():
        for each in message.transforms:
            stamp = each.header.stamp
            try:
                T_parent_child = transform_of(each.transform)
            except ValueError as error:
                logger.warning(
                    "%s: the transform of %r is left out: %s", topic, each.child_frame_id, error
                )
                continue
            parent = each.header.frame_id.removeprefix("/")
            child = each.child_frame_id.removeprefix("/")
            yield parent, child, stamp.sec + 1e-9 * stamp.nanosec, T_parent_child


def transform_of(message: Any) -> FloatArray:
    """``T_parent_child`` ``(4, 4)`` of a ``Transform`` or a ``Pose``; ``ValueError`` where it is none."""
    is_pose = hasattr(message, "position")
    t, q = (
        (message.position, message.orientation)
        if is_pose
        else (message.translation, message.rotation)
    )
    (T,) = poses_of(np.array([[t.x, t.y, t.z]]), np.array([[q.x, q.y, q.z, q.w]]))
    return T


def open_topic(path: Path, topic: str, name: str, asked: Path | None) -> RecordedSequence:
    """Open the images of a topic with what the bag has beside: calibration, true poses, LiDAR scans.

    Args:
        path: of the bag.
        topic: of its images.
        name: of the sequence.
        asked: the camera that the user gave, or None.

    Raises:
        SequenceError: there are no messages, no calibration, or no image that can be read.
        SlamError: the extra ``ros`` is not installed.
    """
    bag = Bag(path)
    messages = StampedMessages(bag, topic)
    stored, stamps = images_of(messages, f"an image of {topic} in {bag.path}"), messages.stamps
    fps = 1.0 / median(np.diff(stamps)) if len(stamps) > 1 else 1.0
    calibration = partial(_calibration, bag, topic, fps, (stored.width, stored.height))
    camera = find_camera_file(
        asked, path.absolute().parent, wanted_by=str(path), images=stored, own=calibration
    )
    mounts: Mounts = {}
    for parent, child, _, T_parent_child in transforms(bag, _STATIC_TOPIC):
        mounts[child] = parent, T_parent_child
    frame = bag.first(topic).header.frame_id
    truth, sources = _true_poses(bag, mounts, frame, stamps), (Source(f"bag/{name}"),)
    extrinsics, scans = _scans(bag, mounts, frame, stamps)
    return RecordedSequence(
        name,
        stored,
        camera,
        stamps,
        sources,
        T_any_camera=truth,
        T_camera_lidar=extrinsics,
        scans=scans,
    )


def camera_topics(path: Path) -> list[str]:
    """Topics of a bag with pictures of a camera, not depth; rectified ones in place of the same camera's raw ones."""
    with closing(Bag(path)) as bag:
        images = bag.topics(bags.IMAGE, bags.COMPRESSED_IMAGE)
        topics = [topic for topic in images if bags.shows_pictures(bag.first(topic), topic)]
    rectified = {_home(topic) for topic in topics if is_rectified(topic)}
    return [topic for topic in topics if is_rectified(topic) or _home(topic) not in rectified]


def _calibration(bag: Bag, topic: str, fps: float, size: tuple[int, int]) -> CameraFile:
    """By the ``camera_info`` beside the images."""
    known = bag.topics(bags.CAMERA_INFO)
    base, home = topic.removesuffix("/compressed"), _home(topic)
    info = next(
        (name for name in (f"{home}/camera_info", f"{base}/camera_info") if name in known), None
    )
    if info is None:
        held = ", ".join(known) or "no camera_info"
        raise SequenceError(
            f"no {home}/camera_info for {topic} in {bag.path}: it has {held}; give --camera"
        )
    return bags.camera_file_of(
        bag.first(info), is_rectified(topic), fps, f"{info} in {bag.path}", size
    )


def _home(topic: str) -> str:
    """The namespace of a camera."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _true_poses(bag: Bag, mounts: Mounts, camera: str, stamps: FloatArray) -> FloatArray | None:
    """``T_any_camera`` at the images' stamps from a topic or frame that is named as truth, NaN where unknown."""
    unused = dict.fromkeys(bag.topics(*_POSITIONS), "has positions without rotations")
    for topic in bag.topics(*_POSES):
        first = bag.first(topic)
        body = getattr(first, "child_frame_id", None)
        T_body_camera = np.eye(4) if body is None else transform_between(mounts, body, camera)
        if not any(map(_TRUTH.search, (topic, first.header.frame_id, body or ""))):
            unused[topic] = "is not named as truth"
        elif T_body_camera is None:
            unused[topic] = f"has no static transform from its {body!r} to the camera's {camera!r}"
        else:
            if body is None:
                logger.warning(
                    "%s does not say whose poses it has: they are taken for the camera's", topic
                )
            known, T_any_body = _poses(StampedMessages(bag, topic))
            return poses_near(T_any_body @ T_body_camera, known, stamps, bag.path)
    moving: dict[tuple[str, str], dict[float, FloatArray]] = {}
    for parent, body, stamp, T_parent_body in transforms(bag, _MOVING_TOPIC):
        moving.setdefault((parent, body), {}).setdefault(stamp, T_parent_body)
    for (parent, body), poses in moving.items():
        T_body_camera = transform_between(mounts, body, camera)
        if T_body_camera is not None and any(map(_TRUTH.search, (parent, body))):
            known = np.sort(list(poses))
            T_any_body = np.stack([poses[stamp] for stamp in known.tolist()])
            return poses_near(T_any_body @ T_body_camera, known, stamps, bag.path)
        unused[f"{parent} to {body} in {_MOVING_TOPIC}"] = (
            "is not named as truth, or not joined to the camera"
        )
    for topic, reason in unused.items():
        logger.warning(
            "%s %s: it is not used; a TUM file of true poses is taken by --truth", topic, reason
        )
    return None


def _poses(messages: StampedMessages) -> tuple[FloatArray, FloatArray]:
    """Stamps ``(M,)`` and poses ``(M, 4, 4)`` of the good messages of a topic."""
    bad, good, T_any_body = BadRows(f"topic {messages.topic}", SequenceError), [], []
    for number in range(len(messages)):
        message = messages.read(number)
        while hasattr(message, "pose"):  # with covariance, and with a header
            message = message.pose
        try:
            T_any_body.append(transform_of(getattr(message, "transform", message)))
            good.append(number)
        except ValueError as error:
            bad.add(number, str(error))
    bad.say(len(good), "a pose a message")
    return messages.stamps[good], np.stack(T_any_body)


def _scans(
    bag: Bag, mounts: Mounts, camera: str, stamps: FloatArray
) -> tuple[FloatArray | None, ArrayReaders]:
    """``T_camera_lidar`` and clouds of the first LiDAR whose mount is known.

    A frame has the cloud nearest to it, if within 50 ms and not nearer to another frame.
    """
    for topic in bag.topics(bags.POINT_CLOUD):
        T_camera_lidar = transform_between(mounts, camera, bag.first(topic).header.frame_id)
        if T_camera_lidar is None:
            logger.warning(
                "%s is not used: no static transform from its frame to the camera's %r",
                topic,
                camera,
            )
            continue
        clouds, where = StampedMessages(bag, topic), f"a cloud of {topic} in {bag.path}"
        pairs = zip(*nearest_pairs(stamps, clouds.stamps, _SCAN_DELAY_S))
        return T_camera_lidar, {
            int(frame): partial(clouds.points, int(cloud), where) for frame, cloud in pairs
        }
    return None, {}


def _find(path: Path, asked: Asked) -> Openers:
    """The cameras of a bag by topic; those of a folder of bags by bag, and by topic where a bag has several."""
    if not is_bag(path):
        paths = sorted(filter(is_bag, path.iterdir())) if path.is_dir() else []
        found: Openers = {}
        for bag in paths:
            cameras = _cameras(bag, asked)
            for topic, opener in cameras.items():
                found[f"{bag.stem}{topic}" if len(cameras) > 1 else bag.stem] = opener
        return found
    cameras = _cameras(path, asked)
    if not cameras:
        with closing(Bag(path)) as opened:
            held = (
                ", ".join(f"{topic} ({kind})" for topic, kind in sorted(opened.types.items()))
                or "nothing"
            )
        raise SequenceError(f"bag {path} has no topic with images of a camera: it holds {held}")
    return cameras


def _cameras(path: Path, asked: Asked) -> Openers:
    """The cameras of a bag by topic."""
    topics, stem = camera_topics(path), path.absolute().stem
    names = [stem + topic.replace("/", "_") if len(topics) > 1 else stem for topic in topics]
    return {
        topic: partial(open_topic, path, topic, name, asked.camera)
        for topic, name in zip(topics, names)
    }


LOADER = Loader("ROS bag", "a .bag, .db3 or .mcap", _find)
