"""README and docs name files, headings and configuration keys that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from erfsfm.config import ExperimentConfig
from slam.config.sections import SlamConfig

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\((?!https?:)([^)\s#]*)(?:#([^)\s]*))?\)")
FILE = re.compile(r"(?<![\w./-])(?:slam|erfsfm|tools|tests|configs|docs)/[\w./-]*\.(?:py|yaml|md)\b")
KEYS = {
    f"{section}.{key}"
    for model in (SlamConfig, ExperimentConfig)
    for section, field in model.model_fields.items()
    for key in getattr(field.annotation, "model_fields", {})
}
SECTIONS = "|".join(sorted({key.partition(".")[0] for key in KEYS}))
KEY = re.compile(rf"(?<![\w./-])(?:{SECTIONS})\.(?!(?:json|md)\b)[a-z_]+\b(?!\.)")


def _anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.fixture(params=PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def page(request: pytest.FixtureRequest) -> Path:
    """One page of the documentation."""
    path: Path = request.param
    return path


def test_links_lead_to_pages_and_headings(page: Path) -> None:
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        path = page if not target else (page.parent / target).resolve()
        assert path.exists(), f"{target} does not exist"
        if anchor:
            assert anchor in _anchors(path), f"{target} has no heading #{anchor}"


def test_files_that_are_named_exist(page: Path) -> None:
    named = set(FILE.findall(page.read_text(encoding="utf-8")))
    assert not [name for name in sorted(named) if not (ROOT / name).exists()]


def test_configuration_keys_that_are_named_exist(page: Path) -> None:
    inline = re.findall(r"`[^`]+`|--set \S+", page.read_text(encoding="utf-8"))
    named = {key for text in inline for key in KEY.findall(text)}
    assert not sorted(named - KEYS)
