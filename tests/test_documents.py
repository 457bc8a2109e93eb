"""README and docs name files, headings, commands and configuration keys that exist."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

import erfsfm.cli
import slam.commands.cli
from erfsfm.config import ExperimentConfig
from slam.config.sections import SlamConfig

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
docs_site = importlib.import_module("docs_site")
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "erfsfm/weights").rglob("README.md")),
]
NAMING = [path for kind in ("slam", "erfsfm", "tools", "tests", "configs") for path in (ROOT / kind).rglob("*.*")]
PROGRAMS = {"erfsfm": erfsfm.cli.app, "erfsfm-slam": slam.commands.cli.app}
LINK = re.compile(r"\]\((?!https?:)([^)\s#]*)(?:#([^)\s]*))?\)")
FILE = re.compile(r"(?<![\w./-])(?:slam|erfsfm|tools|tests|configs|docs)/[\w./-]*\.(?:py|yaml|md)\b")
KEYS = {
    f"{section}.{key}"
    for model in (SlamConfig, ExperimentConfig)
    for section, field in model.model_fields.items()
    for key in getattr(field.annotation, "model_fields", {})
}
SECTIONS = "|".join(sorted({key.partition(".")[0] for key in KEYS}))
KEY = re.compile(rf"(?<![\w./-])(?:{SECTIONS})\.(?!(?:json|md|npz)\b)[a-z_]+\b(?!\.)")


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


def test_pages_that_code_names_exist() -> None:
    missing = []
    for path in NAMING:
        if path.suffix in {".py", ".yaml", ".md", ".j2"}:
            named = re.findall(r"\bdocs/[\w/-]+\.md\b", path.read_text(encoding="utf-8"))
            missing += [f"{path.relative_to(ROOT)}: {name}" for name in named if not (ROOT / name).is_file()]
    assert not missing


def test_the_index_lists_every_page() -> None:
    docs = ROOT / "docs"
    listed = {(docs / target).resolve() for target, _ in LINK.findall((docs / "README.md").read_text(encoding="utf-8"))}
    assert listed == {*docs.rglob("*.md"), *docs.rglob("*.ipynb")} - {docs / "README.md"}


def test_the_site_has_every_page_once() -> None:
    nav = re.findall(r"^ +- (?:.+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    in_docs = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert sorted(nav) == sorted(in_docs - {"README.md"} | docs_site.pages().keys())


def test_commands_that_are_named_exist(page: Path) -> None:
    """Commands within a sentence, often not whole; tests/integration/test_documentation.py reads the others."""
    sentences = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for command in re.findall(r"`((?:erfsfm|erfsfm-slam|python -m) [^`]+)`", sentences):
        program, *words = shlex.split(command.replace("[", "").replace("]", ""))
        if program == "python":
            assert importlib.util.find_spec(words[1]), command
            continue
        verb: Any = typer.main.get_command(PROGRAMS[program])
        while words and words[0] in getattr(verb, "commands", {}):
            verb = verb.commands[words.pop(0)]
        assert not hasattr(verb, "commands") or not words or words[0].startswith("-"), f"no such verb: {command}"
        known = {name for parameter in verb.params for name in parameter.opts} | {"--help"}
        strange = {word for word in words if re.match("--?[a-z]", word)} - known
        assert not strange, f"no such option: {command}"
