"""Fingerprint of the code behind cached results: sources of both packages and versions of libraries."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import scipy

import erfsfm

# They compute nothing that is cached; by the layers in pyproject.toml no other code imports them.
_ABOVE_THE_CACHE = (
    *("slam/cli.py", "slam/__main__.py", "slam/doctor.py", "slam/run.py"),
    *("slam/exports/", "slam/localisation/", "slam/results/"),
    *("erfsfm/cli.py", "erfsfm/training/"),
)


@functools.cache
def code_fingerprint() -> str:
    """Fingerprint of all code behind cached results, with the versions of the libraries that compute them."""
    own = Path(__file__).parents[1], Path(erfsfm.__file__).parent
    libraries = (f"{library.__name__} {library.__version__}" for library in (np, cv2, scipy))
    not_imported = (f"{name} {version(name)}" for name in ("torch", "onnxruntime"))
    return " ".join((fingerprint(own), *libraries, *not_imported))


def fingerprint(packages: Sequence[Path]) -> str:
    """Fingerprint of the sources of some packages, each given by its folder."""
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(package.rglob("*.py")):
            name = path.relative_to(package.parent).as_posix()
            if not name.startswith(_ABOVE_THE_CACHE):
                digest.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()
