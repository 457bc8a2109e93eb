"""A cache of computed arrays on disk; the key of an entry is a digest of all its inputs.

An entry is a file with a checksum before its arrays. It appears whole or not at all, and a damaged one is computed
again. Arrays are kept at their own precision, so that a run with the cache and one without give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import COUNTED
from slam.runtime.errors import SlamError
from slam.runtime.storage.files import write_atomically

logger = logging.getLogger(__name__)


class Digestible(Protocol):
    """A large object with a digest of its content."""

    @property
    def digest(self) -> bytes:
        """SHA-256."""


Given = str | Digestible | NDArray[Any]
Answer = tuple[NDArray[Any], ...]
GetOrCompute = Callable[[str, Sequence[Given], Callable[[], Answer]], Answer]

_FORMAT = b"erfsfm-slam cache 2"
_SUBFOLDER = re.compile("[0-9a-f]{2}")
_CHECK_BYTES = 16
_LENGTH_BYTES = 4


def without_cache(kind: str, given: Sequence[Given], compute: Callable[[], Answer]) -> Answer:
    """A ``GetOrCompute`` that always computes."""
    return compute()


class DiskCache:
    """A folder of entries, shared by any number of sequences, networks and runs."""

    def __init__(self, folder: Path) -> None:
        """Use a folder, made where it is missing.

        Raises:
            SlamError: the folder cannot be made, or is that of something else, such as a recording or a run.
        """
        self._folder = folder
        self._is_writable = True
        try:
            folder.mkdir(parents=True, exist_ok=True)
            names = [path.name for path in folder.iterdir()]
        except OSError as error:
            raise SlamError(f"no cache can be made in {folder}: {error.strerror or error}") from error
        if names and not any(_SUBFOLDER.fullmatch(name) for name in names):
            raise SlamError(f"{folder} is not empty and holds no cache of erfsfm-slam: choose another --cache")

    def read(self, key: str) -> Answer | None:
        """An entry, or None where it is missing or damaged."""
        path = self._path(key)
        try:
            raw = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("cache entry %s cannot be read (%s): computed again", path, error.strerror, extra=COUNTED)
            return None
        check, content = raw[:_CHECK_BYTES], raw[_CHECK_BYTES:]
        if _checksum(content) != check:
            logger.warning("cache entry %s is damaged: computed again", path, extra=COUNTED)
            return None
        return _unpacked(content)

    def write(self, key: str, answer: Answer) -> None:
        """Write an entry; after a failure (a full disk) no more are written, and the run goes on."""
        if not self._is_writable:
            return
        content = _packed(answer)
        try:
            entry = _checksum(content) + content  # damage is found by the checksum: no fsync needed
            write_atomically(self._path(key), lambda file: file.write_bytes(entry), sync=False)
        except SlamError as error:
            logger.warning("the cache is not written any more: %s", error)
            self._is_writable = False

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / key


class CacheNamespace:
    """The entries of one user of a cache, kept apart from other users' entries by its identity."""

    def __init__(self, cache: DiskCache, identity: str) -> None:
        """Use a cache.

        Args:
            cache: shared with others.
            identity: all inputs besides the arguments of `get_or_compute`.
        """
        self._cache = cache
        self._identity = identity.encode()
        self.found = 0
        self.asked = 0

    def get_or_compute(self, kind: str, given: Sequence[Given], compute: Callable[[], Answer]) -> Answer:
        """The arrays by ``compute``, read from the cache where they are there.

        Args:
            kind: name of the computation.
            given: all arguments of the computation, of fixed types for a kind.
            compute: the computation.
        """
        named = hashlib.sha256(b"\0".join((_FORMAT, self._identity, kind.encode())))
        for each in given:
            named.update(_digest(each))
        key = named.hexdigest()
        known = self._cache.read(key)
        if known is not None:
            self.found += 1
            return known
        self.asked += 1
        answer = compute()
        self._cache.write(key, answer)
        return answer


def _digest(given: Given) -> bytes:
    """Digest of a text, of shape and bytes of an array, or of a `Digestible`."""
    if not isinstance(given, str | np.ndarray):
        return given.digest
    content = given.encode() if isinstance(given, str) else repr(given.shape).encode() + given.tobytes()
    return hashlib.sha256(content).digest()


def _packed(answer: Answer) -> bytes:
    """Types and shapes as JSON after its length, then the bytes: NumPy's own header takes longer to read than these."""
    header = json.dumps([(array.dtype.str, array.shape) for array in answer]).encode()
    return b"".join((len(header).to_bytes(_LENGTH_BYTES, "little"), header, *(array.tobytes() for array in answer)))


def _unpacked(content: bytes) -> Answer:
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    arrays: list[NDArray[Any]] = []
    for kind, shape in json.loads(content[_LENGTH_BYTES:start]):
        array = np.frombuffer(content, kind, math.prod(shape), start).reshape(shape).copy()
        arrays.append(array)
        start += array.nbytes
    return tuple(arrays)


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECK_BYTES).digest()
