"""Tar files of a pack, its shards: how one is written, and read from a disk or over HTTP.

The layout is WebDataset's: members whose names agree before the first dot belong together. Here they are a clip, some
consecutive frames of one recording with what the teacher measured of them. Members are decoded as pictures and arrays
of numbers alone; nothing in a shard is executed.
"""

from __future__ import annotations

import http.client
import io
import logging
import re
import tarfile
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from erfsfm.common.config_tree import Section
from erfsfm.common.errors import DataError
from erfsfm.common.files import read_bytes
from erfsfm.common.readers.images import decode_image
from erfsfm.data.compact_label import Bound, decode

logger = logging.getLogger(__name__)

CLIPS_FILE = "clips.npy"
FOLDER = "shards"
POSES = "poses.npy"
MOST_SNIPPETS = 32  # of a clip: its frames are these, and those that the last ones need
_WAITS = (1.0, 4.0, 16.0)  # seconds before a further try
_TIMEOUT = 60.0  # seconds without a byte
_KEY = re.compile(r"(\d{6})-(\d{8})\.(.+)")
_BLOCK = 512  # bytes of a tar file's header, to which members are filled up
_END = 10_240  # bytes to which a tar file is filled up, of which two blocks are its end

Key = tuple[int, int]  # number of a recording in the index, and of the clip's first frame


class ShardIndex(Section):
    """What all shards of a pack have in common."""

    address: str = Field(default=FOLDER, description="folder of the tar files, seen from the pack, or http(s) address")
    files: int = Field(gt=0, description="number of tar files")
    most_bytes: int = Field(gt=0, description="of a tar file")
    sources: int = Field(gt=0, description="source frames of a snippet")
    teacher: Literal["none", "poses", "depth and poses"] = Field(default="none", description="what it measured")
    stride: int = Field(gt=0, description="every how many frames there is a label")


@dataclass(frozen=True)
class Clip:
    """Consecutive frames, encoded; ``place`` names them in errors."""

    place: str
    first: int
    members: dict[str, bytes]

    def image(self, frame: int) -> NDArray[np.uint8]:
        """A frame by its number in the recording, ``(H, W, 3)`` RGB.

        Raises:
            DataError: it is missing, incomplete or no picture.
        """
        return decode_image(self._member(f"{frame - self.first:03d}.jpg"), f"frame {frame} in {self.place}")

    def label(self, frame: int) -> tuple[Bound, Bound]:
        """Least and most inverse depth ``(H, W)`` of a frame.

        Raises:
            DataError: it is missing or damaged.
        """
        try:
            return decode(self._member(f"{frame - self.first:03d}.webp"))
        except ValueError as error:
            raise DataError(f"{self.place}: the label of frame {frame} is damaged ({error}); pack again") from error

    @cached_property
    def T_world_camera(self) -> NDArray[np.float64]:
        """Poses ``(frames, 4, 4)`` in camera heights.

        Raises:
            DataError: they are missing or damaged.
        """
        try:
            poses = np.load(io.BytesIO(self._member(POSES)), allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise DataError(f"{self.place}: the poses are damaged ({error}); pack again") from error
        return np.asarray(poses, dtype=np.float64)

    def _member(self, name: str) -> bytes:
        if name not in self.members:
            raise DataError(f"{self.place} has no {name}; pack again")
        return self.members[name]


@dataclass(frozen=True)
class Shards:
    """The shards of the pack in the folder ``pack``."""

    pack: Path
    index: ShardIndex

    def clips(self) -> NDArray[np.int64]:
        """Shard, recording, first frame and number of frames of each clip, ``(N, 4)``, in the order of the shards.

        Raises:
            DataError: the file is missing or damaged.
        """
        path = self.pack / CLIPS_FILE
        try:
            clips = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(f"{path} is missing or damaged ({error}): copy the pack again") from error
        if clips.ndim != 2 or clips.shape[1] != 4 or clips.dtype.kind != "i" or np.any(np.diff(clips[:, 0]) < 0):
            raise DataError(f"{path} is no list of clips: copy the pack again")
        return np.asarray(clips, dtype=np.int64)

    def read(self, number: int) -> dict[Key, Clip]:
        """The clips of one shard, encoded.

        Raises:
            DataError: the shard is missing, damaged, or cannot be reached.
        """
        address = self.index.address
        if re.match(r"https?://", address):
            place = f"{address.rstrip('/')}/{shard_name(number)}"
            content = _download(place, self.index.most_bytes)
        else:
            place = str(self.pack / address / shard_name(number))
            try:
                content = read_bytes(Path(place), self.index.most_bytes)
            except OSError as error:
                raise DataError(f"{place} cannot be read ({error.strerror or error}): copy the pack again") from error
        clips: dict[Key, Clip] = {}
        try:
            with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
                for member in tar:
                    match = _KEY.fullmatch(member.name)
                    file = tar.extractfile(member) if member.isreg() and not member.issparse() else None
                    if match is not None and file is not None:
                        key = int(match[1]), int(match[2])
                        clip = clips.setdefault(key, Clip(f"{place}, {clip_name(*key)}", key[1], {}))
                        clip.members[match[3]] = file.read()
        except (tarfile.TarError, ValueError, EOFError, OSError) as error:
            raise DataError(f"{place} is damaged ({type(error).__name__}): copy it again") from error
        return clips


class ShardWriter:
    """Tar files in a folder, each filled up to a number of bytes."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._folder = folder
        self._most = most_bytes
        self._number = 0
        self._size = _END
        self._members: list[tuple[str, bytes]] = []

    def write(self, name: str, members: dict[str, bytes]) -> int:
        """Add a clip; returns the number of the shard it is in.

        Raises:
            DataError: it is larger than a shard.
        """
        size = sum(_BLOCK + -(-len(data) // _BLOCK) * _BLOCK for data in members.values())
        if size + _END > self._most:
            raise DataError(
                f"{len(members)} images and labels take {(size + _END) / 1e6:.2f} MB: raise --shard-megabytes, or "
                "lower --quality"
            )
        if self._size + size > self._most:
            self.close()
        self._members += [(f"{name}.{suffix}", data) for suffix, data in members.items()]
        self._size += size
        return self._number

    def close(self) -> None:
        """Complete a shard; the next clip begins another."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with tarfile.open(self._folder / shard_name(self._number), "w", format=tarfile.USTAR_FORMAT) as tar:
            for name, data in self._members:
                member = tarfile.TarInfo(name)
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
        self._number += 1
        self._size, self._members = _END, []


@dataclass(frozen=True)
class InShards:
    """Where the frames of a recording are: it has this ``number`` in the index, which counts labels from ``begin``."""

    shards: Shards
    number: int
    begin: int


def shard_name(number: int) -> str:
    """File of a shard."""
    return f"{number:06d}.tar"


def clip_name(recording: int, first: int) -> str:
    """What the members of a clip have in common."""
    return f"{recording:06d}-{first:08d}"


def _download(url: str, most: int) -> bytes:
    """The content at an address; tried again some times where the connection fails.

    Raises:
        DataError: it is not there, too large, or the connection fails again and again.
    """
    for wait in (*_WAITS, None):
        try:
            with urllib.request.urlopen(url, timeout=_TIMEOUT) as answer:
                content = bytes(answer.read(most + 1))
                wanted = answer.headers.get("Content-Length")
            if len(content) > most:
                raise DataError(f"{url} is larger than the {most} bytes of a shard of this pack: pack and upload again")
            if wanted is None or len(content) == int(wanted):
                return content
            problem = f"{len(content)} of {wanted} bytes came"
        except urllib.error.HTTPError as error:
            if error.code < 500:
                raise DataError(f"{url}: {error}; is the address of the pack's index right?") from error
            problem = str(error)
        except (OSError, http.client.HTTPException, ValueError) as error:
            problem = str(error)
        if wait is None:
            break
        logger.warning("%s: %s; again in %g s", url, problem, wait)
        time.sleep(wait)
    raise DataError(f"{url} cannot be read: {problem}; train again when it can, with --resume where a checkpoint is")
