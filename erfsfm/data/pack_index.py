"""A pack: recordings shrunk to the networks' size, in one folder with an index, ``pack.yaml``.

Frames to train on lie in shards, snippets to validate on in files of their own with the truth beside them. Names, frame
numbers and cameras are those of the originals, so that weights record the same training data.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, ValidationError

from erfsfm.common.config_tree import Section, dump_yaml, first_problem
from erfsfm.common.errors import DataError
from erfsfm.common.files import write_atomically
from erfsfm.common.yaml_file import YamlError, read_yaml
from erfsfm.data.recordings import Recording
from erfsfm.data.shards import InShards, ShardIndex, Shards
from erfsfm.geometry.camera import Camera

INDEX_FILE = "pack.yaml"
_MOST_FRAMES = 10**6  # of one recording: a day at ten frames a second


class PackedCamera(Section):
    """Size and intrinsics of the packed images, pixels."""

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float


class ShardedRecording(Section):
    """Consecutive frames in tar files."""

    name: str = Field(min_length=1, description="as in the leak record, without frames")
    start: int = Field(ge=0, description="number of the first frame")
    frames: int = Field(gt=0, le=_MOST_FRAMES)
    camera: PackedCamera


class PackedRecording(ShardedRecording):
    """Consecutive frames in files that are named by their numbers."""

    folder: str = Field(pattern=r"^[\w-]+$", description="of its files, below images/ and depth/")
    poses: bool = Field(default=False, description="whether true poses of this camera are known")
    depth: list[int] = Field(default_factory=list, description="frames with true depth")


class PackIndex(Section):
    """The content of ``pack.yaml``."""

    recordings: list[PackedRecording] = Field(description="snippets to validate on")
    shards: ShardIndex
    sharded: list[ShardedRecording] = Field(description="recordings in shards, to train on")


def image_file(root: Path, folder: str, frame: int) -> Path:
    """A packed image."""
    return root / "images" / folder / f"{frame:06d}.jpg"


def depth_file(root: Path, folder: str, frame: int) -> Path:
    """A packed depth map, 1/256 m."""
    return root / "depth" / folder / f"{frame:06d}.png"


def poses_file(root: Path, folder: str) -> Path:
    """True poses of a packed recording's camera, in KITTI's format."""
    return root / "poses" / f"{folder}.txt"


def write_index(root: Path, index: PackIndex) -> None:
    """Complete a pack."""
    write_atomically(root / INDEX_FILE, lambda path: path.write_text(dump_yaml(index)))


def read_pack(root: Path) -> list[Recording]:
    """The recordings of a pack.

    Raises:
        DataError: the index is damaged, or a file is missing.
    """
    try:
        index = PackIndex.model_validate(read_yaml(root / INDEX_FILE))
    except YamlError as error:
        raise DataError(str(error)) from error
    except ValidationError as error:
        raise DataError(f"{root / INDEX_FILE} is damaged: {first_problem(error)}; pack again") from error
    shards = Shards(root, index.shards)
    held_out = [_recording(root, entry) for entry in index.recordings]
    return held_out + [_sharded(shards, number, entry) for number, entry in enumerate(index.sharded)]


def _sharded(shards: Shards, number: int, entry: ShardedRecording) -> Recording:
    return Recording(
        entry.name,
        (shards.pack / INDEX_FILE,) * entry.frames,
        Camera(**entry.camera.model_dump()),
        start=entry.start,
        stored=entry.frames,
        without_stops=True,
        packed=InShards(shards, number, entry.start),
    )


def _recording(root: Path, entry: PackedRecording) -> Recording:
    numbers = range(entry.start, entry.start + entry.frames)
    images = tuple(image_file(root, entry.folder, number) for number in numbers)
    with_depth = set(entry.depth)
    depth = tuple(depth_file(root, entry.folder, n) if n in with_depth else None for n in numbers)
    poses = poses_file(root, entry.folder) if entry.poses else None
    missing = [path for path in (*images, *depth, poses) if path is not None and not path.is_file()]
    if missing:
        raise DataError(f"{missing[0]} is missing: copy the pack again")
    return Recording(
        entry.name,
        images,
        Camera(**entry.camera.model_dump()),
        depth=depth if with_depth else None,
        poses_file=poses,
        start=entry.start,
        stored=entry.frames,
        without_stops=True,
    )
