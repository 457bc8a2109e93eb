"""The lock files hold the versions of ``constraints.txt``, hashes for each, and nothing about where they come from."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LOCK, DOCS = ((ROOT / name).read_text() for name in ("requirements.lock", "requirements-docs.lock"))


def pins(text: str) -> dict[str, str]:
    found = re.findall(r"^([A-Za-z][\w.-]*)==([^\s;]+)", text, re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_versions_are_those_of_the_constraints() -> None:
    wanted = pins((ROOT / "constraints.txt").read_text())
    assert pins(LOCK) | pins(DOCS) == pins(DOCS) | pins(LOCK) == wanted, "run make lock"


@pytest.mark.parametrize("lock", [LOCK, DOCS], ids=["requirements", "requirements-docs"])
def test_every_package_has_hashes_and_no_address(lock: str) -> None:
    packages = re.split(r"\n(?=\S)", lock.strip())
    assert len(packages) == len(pins(lock))
    assert not [each.split()[0] for each in packages if "--hash=sha256:" not in each]
    assert "://" not in lock and "--index" not in lock and "--find-links" not in lock


def test_torch_is_left_to_the_user() -> None:
    assert re.search(r"^torch==\S+ ; sys_platform == 'never'", LOCK, re.MULTILINE)
