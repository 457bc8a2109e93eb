"""ONNX graphs kept on disk: to make one takes PyTorch and a second of processor time, to read it neither."""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
from contextlib import suppress
from pathlib import Path

from erfsfm.common.files import read_bytes, write_atomically

_MOST_BYTES = 2**30
_MOST_GRAPHS = 16
_DIGEST_BYTES = 32

logger = logging.getLogger(__name__)


def folder() -> Path:
    """Beside torch's own downloads, so that ``TORCH_HOME`` and ``XDG_CACHE_HOME`` move it."""
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.environ.get("TORCH_HOME") or Path(caches, "torch")).expanduser().with_name("erfsfm")


def is_kept(made_from: str) -> bool:
    """Whether there is a file of this graph."""
    return _path(made_from).is_file()


def kept(made_from: str) -> bytes | None:
    """An ONNX file from the folder; None if it is not there or damaged.

    Args:
        made_from: all that the graph depends on, but torch and our code.
    """
    path = _path(made_from)
    with suppress(OSError):
        content = read_bytes(path, _MOST_BYTES)
        digest, graph = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if hashlib.sha256(graph).digest() == digest:
            path.touch()
            return graph
    return None


def keep(made_from: str, graph: bytes) -> None:
    """Write an ONNX file and delete the least recently used ones. A folder that cannot be written costs time only."""
    content = hashlib.sha256(graph).digest() + graph
    try:
        write_atomically(_path(made_from), lambda partial: partial.write_bytes(content), sync=False)
        for old in sorted(folder().glob("*.onnx"), key=lambda file: file.stat().st_mtime)[:-_MOST_GRAPHS]:
            old.unlink()
    except OSError as error:
        logger.info("the network's graph is not kept: %s", error)


def _path(made_from: str) -> Path:
    torch_version = importlib.metadata.version("torch")
    return folder() / f"{hashlib.sha256(f'{made_from} {torch_version} {_code()}'.encode()).hexdigest()}.onnx"


def _code() -> str:
    """Digest of the files from which graphs are made: networks and their geometry."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for file in sorted([*package.glob("networks/*.py"), *package.glob("geometry/*.py")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()
