"""Whatever is wrong with an archive, reading it gives what was written or one clear error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.frames import Intrinsics, View
from slam.loops.places import Places
from slam.pipeline.checkpoint import read_keyframes, write_keyframes
from slam.pipeline.observer import Keyframe
from slam.runtime.errors import RunError
from slam.runtime.storage.spill import SpillFile


def keyframes(path: Path) -> None:
    spill_file, rng = SpillFile(), np.random.default_rng(0)
    image, depth = rng.integers(0, 255, (6, 8, 3)).astype(np.uint8), rng.random((6, 8)).astype(np.float32)
    write_keyframes(path, [Keyframe(k, spill_file.put(image), spill_file.put(depth)) for k in range(2)])


def places(path: Path) -> None:
    rng = np.random.default_rng(0)
    view = View(3, rng.random((5, 2)).astype(np.float32), np.ones((5, 32), np.uint8), np.ones((5, 3), np.float32))
    Places(Intrinsics(8, 6, 5.0, 5.0, 3.5, 2.5), (view,), np.eye(4)[None]).write(path)


READERS = {
    "keyframes.npz": (keyframes, lambda path: [(k.index, k.image) for k in read_keyframes(path)]),
    "places.npz": (places, Places.read),
}


@pytest.mark.parametrize("name", READERS)
def test_no_damage_escapes_as_another_error(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write, read = READERS[name]
    write(path)
    whole = path.read_bytes()
    refused = 0
    for at in range(0, len(whole), 7):
        for damaged in (whole[:at], whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]):
            path.write_bytes(damaged)
            try:
                read(path)
            except RunError as error:
                refused += 1
                assert name in str(error) and "\n" not in str(error)
    assert refused > len(whole) / 7
