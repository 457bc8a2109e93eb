"""ONNX graphs kept on disk: to make one takes a second of processor time, to read it none."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch

from erfsfm.files import read_bytes, write_atomically

_MOST_BYTES = 2**30
_MOST_GRAPHS = 16
_DIGEST_BYTES = 32

logger = logging.getLogger(__name__)


def folder() -> Path:
    """Beside torch's own downloads, so that ``TORCH_HOME`` and ``XDG_CACHE_HOME`` move it."""
    return Path(torch.hub.get_dir()).parent.with_name("erfsfm")


def kept_graph(made_from: str, make: Callable[[], bytes]) -> bytes:
    """An ONNX file from the folder, or made and kept there; the graphs used least recently are deleted.

    A folder that cannot be written costs time alone. A damaged file is replaced.

    Args:
        made_from: all that the graph depends on, but torch and our code.
        make: gives its bytes.
    """
    key = hashlib.sha256(f"{made_from} {torch.__version__} {_code()}".encode()).hexdigest()
    path = folder() / f"{key}.onnx"
    with suppress(OSError):
        content = read_bytes(path, _MOST_BYTES)
        digest, graph = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if hashlib.sha256(graph).digest() == digest:
            path.touch()
            return graph
    graph = make()
    try:
        write_atomically(path, lambda partial: partial.write_bytes(hashlib.sha256(graph).digest() + graph), sync=False)
        for old in sorted(folder().glob("*.onnx"), key=lambda file: file.stat().st_mtime)[:-_MOST_GRAPHS]:
            old.unlink()
    except OSError as error:
        logger.info("the network's graph is not kept: %s", error)
    return graph


def _code() -> str:
    """Digest of the files from which graphs are made: networks, their geometry, and the parts that inference runs."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for file in sorted([*package.glob("networks/*.py"), *package.glob("geometry/*.py"), package / "inference.py"]):
        digest.update(file.read_bytes())
    return digest.hexdigest()
