"""Fingerprint of the code behind cached results: sources of both packages and versions of libraries."""

from __future__ import annotations

import ast
import functools
import hashlib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import scipy

_ROOT = "slam.prediction.assembly"  # it computes all cached results: outputs of networks
_PACKAGES = ("slam", "erfsfm")


@functools.cache
def code_fingerprint() -> str:
    """Fingerprint of all code behind cached results, with the versions of the libraries that compute them."""
    libraries = (f"{library.__name__} {library.__version__}" for library in (np, cv2, scipy))
    not_imported = (f"{name} {version(name)}" for name in ("torch", "onnxruntime"))
    return " ".join((fingerprint(Path(__file__).parents[3]), *libraries, *not_imported))


def fingerprint(root: Path) -> str:
    """Fingerprint of the sources behind cached results, of the packages in a folder."""
    digest = hashlib.sha256()
    for path in sources(root):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def sources(root: Path) -> list[Path]:
    """Files behind cached results: all that compute them, and all of both packages that these import."""
    found: dict[str, Path] = {}
    waiting = [_ROOT]
    while waiting:
        name = waiting.pop()
        place = root.joinpath(*name.split("."))
        path = next((p for p in (place.with_suffix(".py"), place / "__init__.py") if p.is_file()), None)
        if path is not None and name not in found:
            found[name] = path
            waiting += _imported(path)
    return sorted(found.values())


def _imported(path: Path) -> Iterator[str]:
    """Names that a file imports, with the folders around them; the doors of both packages compute nothing."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{each.name}" for each in node.names]
        for parts in (name.split(".") for name in names):
            if parts[0] in _PACKAGES:
                yield from (".".join(parts[:count]) for count in range(2, len(parts) + 1))
