"""Answers of the networks kept on disk, so that a run with other settings of the graph need not ask them again.

An entry is a file named by everything its answer depends on: the networks and the bytes and size of every image.
Disparity is kept as the network gave it, at its own size and precision, so that a run from the cache and one
without give the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import logging
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import SlamError
from slam.files import write_atomically
from slam.frames import Image
from slam.networks import Networks

logger = logging.getLogger(__name__)

_FORMAT = b"erfsfm-slam cache 1"
_CHECK_BYTES = 16


class CachedNetworks:
    """Networks that are asked once for each image and snippet; everything else is read."""

    def __init__(self, networks: Networks, identity: str, folder: Path) -> None:
        """Use a folder, made where it is missing.

        Args:
            networks: whom to ask.
            identity: everything that decides their answer beside the images: weights, size, kind of device.
            folder: shared by any number of networks and sequences.

        Raises:
            SlamError: the folder cannot be made.
        """
        self.sources = networks.sources
        self._networks = networks
        self._store = _Store(folder)
        self._identity = identity.encode()
        self._digests: deque[tuple[Image, bytes]] = deque(maxlen=networks.sources + 1)

    @property
    def found(self) -> int:
        """Answers that were read."""
        return self._store.found

    @property
    def asked(self) -> int:
        """Answers that the networks had to give."""
        return self._store.missed

    def disparity(self, image: Image) -> NDArray[np.float32]:
        """Unscaled 1/depth ``(h, w)`` of an image, at the networks' own size."""
        return self._store.fetch(self._key(b"disparity", [image]), lambda: self._networks.disparity(image))

    def poses(self, images: Sequence[Image]) -> NDArray[np.float64]:
        """``T_source_target`` ``(N, 4, 4)`` of N + 1 images in time order, the target in the middle."""
        return self._store.fetch(self._key(b"poses", images), lambda: self._networks.poses(images))

    def _key(self, kind: bytes, images: Sequence[Image]) -> str:
        key = hashlib.sha256(b"\0".join((_FORMAT, self._identity, kind)))
        for image in images:
            key.update(self._digest(image))
        return key.hexdigest()

    def _digest(self, image: Image) -> bytes:
        """Of size and bytes; an image is seen by several snippets and hashed once."""
        for known, digest in self._digests:
            if known is image:
                return digest
        hashed = hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes())
        self._digests.append((image, hashed.digest()))
        return hashed.digest()


class _Store:
    """Arrays by name, each in a file with a checksum before it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._is_writable = True
        self.found = self.missed = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SlamError(f"no cache can be made in {folder}: {error.strerror or error}") from error

    def fetch(self, key: str, compute: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """The array of a key, computed and written where there is no whole entry."""
        path = self._folder / key[:2] / f"{key}.npy"
        stored = _read(path)
        if stored is not None:
            self.found += 1
            return stored
        self.missed += 1
        array = compute()
        if self._is_writable:
            self._write(path, array)
        return array

    def _write(self, path: Path, array: NDArray[Any]) -> None:
        """Keep an array; a full disk ends the keeping and not the run."""
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        content = buffer.getvalue()
        try:
            write_atomically(path, lambda file: file.write_bytes(_checksum(content) + content))
        except SlamError as error:
            logger.warning("the cache keeps nothing more: %s", error)
            self._is_writable = False


def _read(path: Path) -> NDArray[Any] | None:
    """An entry, or None where it is missing or not as it was written."""
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        logger.warning("cache entry %s cannot be read (%s): computed again", path, error.strerror)
        return None
    check, content = raw[:_CHECK_BYTES], raw[_CHECK_BYTES:]
    if _checksum(content) != check:
        logger.warning("cache entry %s is damaged: computed again", path)
        return None
    array: NDArray[Any] = np.load(io.BytesIO(content), allow_pickle=False)
    return array


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECK_BYTES).digest()
