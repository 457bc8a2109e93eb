"""The lock file holds the versions of ``constraints.txt``, a hash for each, and nothing about where they come from."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK = (ROOT / "requirements.lock").read_text()


def pins(text: str) -> dict[str, str]:
    found = re.findall(r"^([A-Za-z][\w.-]*)==([^\s;]+)", text, re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_versions_are_those_of_the_constraints() -> None:
    assert pins(LOCK) == pins((ROOT / "constraints.txt").read_text()), "run make lock"


def test_every_package_has_hashes_and_no_address() -> None:
    packages = re.split(r"\n(?=\S)", LOCK.strip())
    assert len(packages) == len(pins(LOCK))
    assert not [each.split()[0] for each in packages if "--hash=sha256:" not in each]
    assert "://" not in LOCK and "--index" not in LOCK and "--find-links" not in LOCK


def test_torch_is_left_to_the_user() -> None:
    assert re.search(r"^torch==\S+ ; sys_platform == 'never'", LOCK, re.MULTILINE)
