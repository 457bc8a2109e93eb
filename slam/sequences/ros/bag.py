"""The topics and messages of a bag.

Messages are read by rosbags' own definitions of the standard types. Those that a bag carries are not used, for rosbags
would make code of them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slam.runtime.errors import SequenceError
from slam.runtime.imports import import_extra

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
_METADATA = "metadata.yaml"
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
_TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_NANOSECONDS = 10**9
# MCAP: the footer with the magic bytes behind it, and kinds of records
_FOOTER_BYTES, _SCHEMA, _CHANNEL = 37, 3, 4
_ROS_ENCODINGS = ("cdr", "ros1")


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
            self._types = typesys.get_typestore(stores.ROS1_NOETIC if self._is_ros1 else stores.ROS2_HUMBLE)
            for name in _TRANSFORM_TYPES:
                if name not in self._types.types:
                    self._types.register(typesys.get_types_from_msg(_TRANSFORMS, name))
            self.types: dict[str, str] = {each.topic: each.msgtype for each in self._reader.connections}

    def topics(self, *types: str) -> list[str]:
        """Topics of some message types that have messages, sorted."""
        counts = {each.topic: each.msgcount for each in self._reader.connections}
        return sorted(topic for topic, kind in self.types.items() if kind in types and counts[topic] != 0)

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
        """The first message of a topic."""
        message = next(self.messages(topic), None)
        if message is None:
            raise SequenceError(f"topic {topic} of {self.path} has no messages")
        return message

    def parse(self, topic: str, data: bytes) -> Any:
        """A message as stored, by the type of its topic."""
        with self._errors():
            parse = self._types.deserialize_ros1 if self._is_ros1 else self._types.deserialize_cdr
            return parse(data, self.types[topic])

    def stamp_ns(self, data: bytes) -> int:
        """The stamp in nanoseconds of a message as stored whose first field is a header, without reading all of it."""
        with self._errors():
            if self._is_ros1:
                seconds, nanoseconds = struct.unpack_from("<II", data, 4)  # after the sequence number
            else:
                order = "<" if data[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)  # after the encapsulation
        return int(seconds) * _NANOSECONDS + int(nanoseconds)

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
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            held = ", ".join(foreign_topics(self.path) if self.path.suffix == ".mcap" else [])
            if held:
                cure = "convert it to a bag of ROS 2"
                raise SequenceError(f"{self.path} is not of ROS: it holds {held}; {cure}") from error
            raise SequenceError(f"bag {self.path} cannot be read ({reason}): copy it again, or reindex it") from error


def foreign_topics(path: Path) -> list[str]:
    """Topics of an MCAP file with schema and encoding, where that is not of ROS, by the summary at its end."""
    found, schemas = [], {0: "no schema"}
    try:
        data = path.read_bytes()
        place, end = struct.unpack_from("<Q", data, len(data) - _FOOTER_BYTES + 9)[0], len(data) - _FOOTER_BYTES
        while 0 < place < end:
            kind, length = struct.unpack_from("<BQ", data, place)
            content, place = data[place + 9 : place + 9 + length], place + 9 + length
            if kind == _SCHEMA:
                schemas[struct.unpack_from("<H", content)[0]] = _text(content, 2)[0]
            if kind == _CHANNEL:
                topic, after = _text(content, 4)
                encoding = _text(content, after)[0]
                if encoding not in _ROS_ENCODINGS:
                    found.append(f"{topic} ({schemas.get(struct.unpack_from('<H', content, 2)[0])}, {encoding})")
    except (OSError, struct.error, UnicodeDecodeError):
        return []
    return found


def _text(content: bytes, start: int) -> tuple[str, int]:
    """A string of MCAP, and where it ends."""
    (length,) = struct.unpack_from("<I", content, start)
    return content[start + 4 : start + 4 + length].decode(), start + 4 + length


def is_bag(path: Path) -> bool:
    """Whether a path has the name of a bag, or is the folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / _METADATA).is_file() and any(file.suffix in BAG_SUFFIXES[1:] for file in path.iterdir())
    return path.suffix in BAG_SUFFIXES
