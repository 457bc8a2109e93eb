"""The topics and messages of a bag, and the images, cameras and point clouds in its messages.

Messages are read by rosbags' own definitions of the standard types. Those that a bag carries are not used, for rosbags
would make code of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import CameraFile, camera_of
from erfsfm.common.readers.images import Stretch, decode_image, decode_values
from slam.frames import Image
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.runtime.imports import import_extra
from slam.sequences.camera_file import lens_model, pinhole_keys

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
_METADATA = "metadata.yaml"
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
_TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_NANOSECONDS = 10**9
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, POINT_CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"

SIXTEEN_BITS = ("mono16", "16UC1")
_CONVERSIONS: dict[
    str, tuple[int, int | None]
] = {  # encoding: channels, OpenCV's conversion to RGB
    "rgb8": (3, None),
    **dict.fromkeys(("8UC3", "bgr8"), (3, cv2.COLOR_BGR2RGB)),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    **dict.fromkeys(("mono8", "8UC1", *SIXTEEN_BITS), (1, cv2.COLOR_GRAY2RGB)),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
}
_FLOAT32 = 7  # PointField.FLOAT32


class Bag:
    """An open bag: a ``.bag`` file of ROS 1, or a folder, ``.db3`` or ``.mcap`` file of ROS 2.

    Attributes:
        path: of the bag.
        types: the message type of each topic, as ``sensor_msgs/msg/Image``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._is_ros1 = path.suffix == ".bag"
        rosbag1, rosbag2, typesys = import_extra("ros")
        with self._errors():
            self._reader: Any = (rosbag1 if self._is_ros1 else rosbag2).Reader(path)
            self._reader.open()
            stores = typesys.Stores
            self._types = typesys.get_typestore(
                stores.ROS1_NOETIC if self._is_ros1 else stores.ROS2_HUMBLE
            )
            for name in _TRANSFORM_TYPES:
                if name not in self._types.types:
                    self._types.register(typesys.get_types_from_msg(_TRANSFORMS, name))
            self.types: dict[str, str] = {
                each.topic: each.msgtype for each in self._reader.connections
            }

    def topics(self, *types: str) -> list[str]:
        """Topics of some message types that have messages, sorted."""
        counts = {each.topic: each.msgcount for each in self._reader.connections}
        return sorted(
            topic for topic, kind in self.types.items() if kind in types and counts[topic] != 0
        )

    def raw(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """The messages of a topic as stored, with the times at which they were recorded, from ``start_ns`` on."""
        connections = [each for each in self._reader.connections if each.topic == topic]
        with self._errors():
            for _, time_ns, data in self._reader.messages(connections=connections, start=start_ns):
                yield time_ns, data

    def messages(self, topic: str) -> Iterator[Any]:
        """The messages of a topic, in the order in which they were recorded."""
        for _, data in self.raw(topic):
            yield self.parse(topic, data)

    def first(self, topic: str) -> Any:
        """The first message of a topic.

        Raises:
            SequenceError: the topic has no messages, or the bag cannot be read.
        """
        message = next(self.messages(topic), None)
        if message is None:
            raise SequenceError(f"topic {topic} of {self.path} has no messages")
        return message

    def parse(self, topic: str, data: bytes) -> Any:
        """A message as stored, by the type of its topic."""
        with self._errors():
            parse = self._types.deserialize_ros1 if self._is_ros1 else self._types.deserialize_cdr
            return parse(data, self.types[topic])

    def stamp_ns(self, topic: str, data: bytes) -> int:
        """The stamp in nanoseconds of a message as stored that has a header."""
        stamp = self.parse(topic, data).header.stamp
        return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)

    def close(self) -> None:
        """Close the file; nothing can be read any more."""
        self._reader.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except SequenceError:
            raise
        except Exception as error:  # of whatever kind a damaged file raises inside rosbags
            reason = f"{type(error).__name__}: {error}"
            raise SequenceError(
                f"bag {self.path} cannot be read ({reason}): copy it again, reindex it, or convert it to a bag of ROS 2"
            ) from error


def is_bag(path: Path) -> bool:
    """Whether a path has the name of a bag, or is the folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / _METADATA).is_file() and any(
            file.suffix in BAG_SUFFIXES[1:] for file in path.iterdir()
        )
    return path.suffix in BAG_SUFFIXES


def shows_pictures(message: Any, topic: str) -> bool:
    """Whether an image or compressed image of a topic shows what a camera sees, not depth."""
    if hasattr(message, "encoding"):
        is_depth = message.encoding == "16UC1" and "depth" in topic.lower()
        return message.encoding in _CONVERSIONS and not is_depth
    return "compressedDepth" not in message.format


def values_of(message: Any, where: str) -> NDArray[Any]:
    """The values ``(H, W, C)`` of an ``Image`` as stored, or those of a ``CompressedImage``.

    Args:
        message: of the bag.
        where: its name, for errors.

    Raises:
        SequenceError: the encoding is unknown, or bytes are missing.
        DataError: a compressed image cannot be decoded.
    """
    if hasattr(message, "format"):
        return decode_values(bytes(message.data), where)
    encoding = message.encoding
    if encoding not in _CONVERSIONS:
        raise SequenceError(f"{where} has encoding {encoding}; known are {', '.join(_CONVERSIONS)}")
    channels, _ = _CONVERSIONS[encoding]
    sample = np.dtype(
        f"{'>' if message.is_bigendian else '<'}u{2 if encoding in SIXTEEN_BITS else 1}"
    )
    height, width, step = message.height, message.width, message.step
    row = width * channels * sample.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not 0 < row <= step or len(data) < height * step:
        raise SequenceError(
            f"{where} has {len(data)} bytes for {width}x{height} pixels of {encoding}"
        )
    values = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row]).view(sample)
    return values.reshape(height, width, channels).astype(sample.newbyteorder("="))


def image_of(message: Any, where: str, stretch: Stretch | None = None) -> Image:
    """The picture ``(H, W, 3)`` uint8 RGB of an ``Image`` or a ``CompressedImage``.

    Values of 16 bits are stretched; without a ``stretch`` by their own range.

    Args:
        message: of the bag.
        where: its name, for errors.
        stretch: of 16 bits to 8; None for that of this image.

    Raises:
        SequenceError: the encoding is unknown, or bytes are missing.
        DataError: a compressed image cannot be decoded.
    """
    if hasattr(message, "format"):
        return decode_image(bytes(message.data), where, stretch)
    picture, (_, conversion) = values_of(message, where), _CONVERSIONS[message.encoding]
    if picture.dtype == np.uint16:
        picture = (stretch or Stretch.of([picture])).apply(picture)
    return np.array(
        picture if conversion is None else cv2.cvtColor(picture, conversion), dtype=np.uint8
    )


def camera_file_of(
    info: Any, rectified: bool, fps: float, where: str, size: tuple[int, int] | None = None
) -> CameraFile:
    """The camera of a ``CameraInfo``: K with its distortion, or P of rectified images, of the images as they come.

    The calibration is of the whole sensor; images are its region of interest, binned (REP 104). Some drivers state a
    binning of images that are whole: those of ``size`` (width, height) as large as the calibration are.

    Args:
        info: the ``CameraInfo``.
        rectified: whether the images are.
        fps: their rate, frames a second.
        where: the name of the message, for errors.
        size: width and height of the images, pixels; None where they are not known.

    Raises:
        SequenceError: the lens is unknown, or there is no calibration.
        DataError: the calibration is impossible.
    """
    K, P, distortion = (
        getattr(info, key.upper() if hasattr(info, key.upper()) else key) for key in "kpd"
    )
    try:
        used = [] if rectified else [float(value) for value in distortion]
        model = lens_model(info.distortion_model if any(used) else None, used)
    except DataError as error:
        raise SequenceError(f"{where}: {error}") from error
    (fx, _, cx, *_), (_, fy, cy, *_), _ = np.reshape(P if rectified else K, (3, -1)).tolist()
    if not (fx > 0 and fy > 0):
        raise SequenceError(
            f"{where} has no calibration, its focal length is {fx:g}: give --camera"
        )
    width, height = info.width, info.height
    if size is not None and not (width and height):
        width, height = size
    roi = info.roi
    if size != (width, height):
        binning_x, binning_y = max(info.binning_x, 1), max(info.binning_y, 1)
        if roi.width and roi.height:
            width, height = roi.width, roi.height
        width, height = width // binning_x, height // binning_y
        fx, fy = fx / binning_x, fy / binning_y
        cx = (cx - roi.x_offset + 0.5) / binning_x - 0.5
        cy = (cy - roi.y_offset + 0.5) / binning_y - 0.5
    coefficients = [] if model == "pinhole" else used
    keys = pinhole_keys(
        width, height, fx, fy, cx, cy, fps=fps, model=model, distortion=coefficients
    )
    return camera_of(keys, where)


def is_rectified(topic: str) -> bool:
    """Whether a topic of images is named as rectified ones are."""
    return topic.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")


def points_of(cloud: Any, where: str) -> FloatArray:
    """The finite points ``(P, 3)`` of a ``PointCloud2`` in its frame, metres.

    Args:
        cloud: a ``PointCloud2``.
        where: its name, for errors.

    Raises:
        DataError: x, y and z are not there as float32, or bytes are missing.
    """
    offsets = {field.name: field.offset for field in cloud.fields if field.datatype == _FLOAT32}
    if not {"x", "y", "z"} <= offsets.keys():
        raise DataError(f"{where} has no x, y and z as float32")
    count, step = cloud.width * cloud.height, cloud.point_step
    data: NDArray[np.uint8] = np.asarray(cloud.data, dtype=np.uint8)
    if len(data) < count * step:
        raise DataError(f"{where} has {len(data)} bytes for {count} points of {step}")
    formats = [f"{'>' if cloud.is_bigendian else '<'}f4"] * 3
    places = [offsets[axis] for axis in "xyz"]
    layout = np.dtype(
        {"names": list("xyz"), "formats": formats, "offsets": places, "itemsize": step}
    )
    table = np.frombuffer(data[: count * step].tobytes(), layout)
    points = np.column_stack([table[axis].astype(np.float64) for axis in "xyz"])
    return points[np.isfinite(points).all(axis=1)]
