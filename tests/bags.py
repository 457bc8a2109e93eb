"""Bags written by rosbags: ROS 1, ROS 2 with SQLite and with MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

rosbags = pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

FIRST_NS, STEP_NS = 1403715273262142976, 50_000_000


class BagWriter:
    """Adds messages to a bag; ``make`` builds one by its short type, such as ``Image``, and its fields."""

    def __init__(self, path: Path, kind: str) -> None:
        self.is_ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            transforms = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
            self.path = path.with_suffix(".bag")
            self.writer: Any = Writer1(self.path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.path, self.writer = path, Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}
        self.camera_frame = "camera"
        self.writer.open()

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make(
            "std_msgs/msg/Header",
            **({"seq": 0} if self.is_ros1 else {}),
            stamp=stamp,
            frame_id=frame,
        )

    def transform(
        self,
        position: tuple[float, float, float],
        quaternion_xyzw: tuple[float, ...] = (0, 0, 0, 1),
    ) -> Any:
        t = self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, position))))
        q = self.make(
            "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, quaternion_xyzw)))
        )
        return self.make("geometry_msgs/msg/Transform", translation=t, rotation=q)

    def stamped_transform(self, stamp_ns: int, parent: str, child: str, transform: Any) -> Any:
        kind = "geometry_msgs/msg/TransformStamped"
        return self.make(
            kind, header=self.header(stamp_ns, parent), child_frame_id=child, transform=transform
        )

    def mount(self, parent: str, child: str, transform: Any) -> None:
        each = self.stamped_transform(FIRST_NS, parent, child, transform)
        self.write(
            "/tf_static", FIRST_NS - 1, self.make("tf2_msgs/msg/TFMessage", transforms=[each])
        )

    def image(
        self, topic: str, stamp_ns: int, pixels: np.ndarray, encoding: str, late_ns: int = 0
    ) -> None:
        """The image, recorded ``late_ns`` after its stamp; rows end with three bytes of padding."""
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        padded = np.pad(rows, ((0, 0), (0, 3)))
        message = self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns, self.camera_frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=padded.shape[1],
            data=padded.ravel(),
        )
        self.write(topic, stamp_ns + late_ns, message)

    def camera_info(
        self,
        topic: str,
        camera: Any,
        model: str,
        distortion: tuple[float, ...] = (),
        binning: int = 0,
        region: tuple[int, int, int, int] = (0, 0, 0, 0),
    ) -> None:
        """``region`` is x offset, y offset, width and height of the images on the sensor."""
        K = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], np.float64)
        P = np.insert(
            K.reshape(3, 3) + np.diag([1, 1, 0]), 3, 0, axis=1
        ).ravel()  # focal lengths 1 pixel longer
        values = {"d": np.array(distortion, np.float64), "k": K, "r": np.eye(3).ravel(), "p": P}
        roi = dict(zip(("x_offset", "y_offset", "width", "height"), region)) | {"do_rectify": False}
        message = self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(FIRST_NS, self.camera_frame),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **roi),
            **{key.upper() if self.is_ros1 else key: value for key, value in values.items()},
        )
        self.write(topic, FIRST_NS, message)

    def write(self, topic: str, time_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialise = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, serialise(message, kind))

    def close(self) -> Path:
        self.writer.close()
        return self.path
