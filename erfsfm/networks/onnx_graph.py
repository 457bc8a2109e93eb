"""Networks run by ONNX Runtime: half of PyTorch's processor time on a CPU, and no PyTorch where the graph is kept.

Graphs are kept on disk: to make one takes PyTorch and a second of processor time, to read it neither.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession

from erfsfm.common.files import read_bytes, write_atomically
from erfsfm.common.processes import open_session

if TYPE_CHECKING:
    from torch import nn

Array = NDArray[np.float32]
_MOST_BYTES = 2**30
_MOST_GRAPHS = 16
_DIGEST_BYTES = 32
logger = logging.getLogger(__name__)


class OnnxGraph:
    """A network that is exported at its first call with inputs of each size and run by ONNX Runtime from then on.

    Outputs equal the network's up to rounding.
    """

    def __init__(self, network: Callable[[], nn.Module], threads: int, identity: str) -> None:
        """Prepare.

        Args:
            network: gives it in evaluation mode, with one output; not called where its graph is kept.
            threads: to run on.
            identity: of the network with its weights, by which the graph is kept on disk.
        """
        self._network = network
        self._threads = threads
        self._identity = identity
        self._infer: dict[str, Callable[..., Array]] = {}  # by the shapes of the inputs

    def __call__(self, *inputs: Array | list[Array]) -> Array:
        """The network's output."""
        key = self._key([array.shape for array in _flat(inputs)])
        if key not in self._infer:
            graph = kept(key)
            if graph is None:
                from erfsfm.networks.torch_network import exported, tensors

                graph = exported(self._network(), tensors(inputs))
                keep(key, graph)
            self._infer[key] = partial(_run, open_session(graph, self._threads))
        return self._infer[key](*inputs)

    def is_kept(self, *shapes: tuple[int, ...]) -> bool:
        """Whether there is a graph for inputs of these shapes on disk."""
        return _path(self._key(shapes)).is_file()

    def _key(self, shapes: Sequence[tuple[int, ...]]) -> str:
        return f"{self._identity} {list(shapes)}"


def _flat(inputs: Sequence[Array | list[Array]]) -> list[Array]:
    return [array for given in inputs for array in (given if isinstance(given, list) else [given])]


def _run(session: InferenceSession, *inputs: Array | list[Array]) -> Array:
    names = [entry.name for entry in session.get_inputs()]
    output: Array = session.run(None, dict(zip(names, _flat(inputs), strict=True)))[0]
    return output


def folder() -> Path:
    """Beside torch's own downloads, so that ``TORCH_HOME`` and ``XDG_CACHE_HOME`` move it."""
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return (
        Path(os.environ.get("TORCH_HOME") or Path(caches, "torch")).expanduser().with_name("erfsfm")
    )


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
        write_atomically(_path(made_from), content, sync=False)
        for old in sorted(folder().glob("*.onnx"), key=lambda file: file.stat().st_mtime)[
            :-_MOST_GRAPHS
        ]:
            old.unlink()
    except OSError as error:
        logger.info("the network's graph is not kept: %s", error)


def _path(made_from: str) -> Path:
    """By the files, too, from which graphs are made: networks and their geometry."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    digest.update(f"{made_from} {importlib.metadata.version('torch')}".encode())
    for file in sorted([*package.glob("networks/*.py"), package / "geometry.py"]):
        digest.update(file.read_bytes())
    return folder() / f"{digest.hexdigest()}.onnx"
