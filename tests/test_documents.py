"""README and docs name files, headings, commands and configuration keys that exist: one walk over the pages each."""

from __future__ import annotations

import importlib
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import typer

import erfsfm.cli
import slam.commands.cli
from erfsfm.config import ExperimentConfig
from slam.config.sections import SlamConfig

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
docs_site = importlib.import_module("docs_site")
DOCS = sorted((ROOT / "docs").rglob("*.md"))
# the record of a network's training and the list of changes name what there was
PAGES = {
    path: path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS)
}
LINKED = PAGES | {
    path: path.read_text()
    for path in (ROOT / "CHANGELOG.md", *ROOT.glob("erfsfm/weights/*/README.md"))
}
PROGRAMS: dict[str, Any] = {
    "erfsfm": typer.main.get_command(erfsfm.cli.app),
    "erfsfm-slam": typer.main.get_command(slam.commands.cli.app),
}
LINK = re.compile(r"\]\((?!https?:)([^)\s#]*)(?:#([^)\s]*))?\)")
KINDS = ("slam", "erfsfm", "tools", "tests", "configs")
FILE = re.compile(
    r"(?<![\w./-])(?:slam|erfsfm|tools|tests|configs|docs)/[\w./-]*\.(?:py|yaml|md)\b"
)
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


def test_links_lead_to_pages_and_headings():
    lost = []
    for page, text in LINKED.items():
        for target, anchor in LINK.findall(text):
            path = page if not target else (page.parent / target).resolve()
            if not path.exists() or (anchor and anchor not in _anchors(path)):
                lost.append(f"{page.name}: {target}#{anchor}")
    assert not lost


def test_files_and_configuration_keys_that_are_named_exist():
    strange = []
    paths = [
        f"/{path.relative_to(ROOT).as_posix()}"
        for kind in KINDS
        for path in (ROOT / kind).rglob("*.py")
    ]
    for page, text in PAGES.items():
        strange += [
            f"{page.name}: {name}" for name in FILE.findall(text) if not (ROOT / name).exists()
        ]
        modules = re.findall(r"`([a-z_0-9/]+\.py)`", text)
        strange += [
            f"{page.name}: {name}"
            for name in modules
            if not any(f"/{name}" in path for path in paths)
        ]
        named = {
            key for part in re.findall(r"`[^`]+`|--set \S+", text) for key in KEY.findall(part)
        }
        strange += [f"{page.name}: {key}" for key in named - KEYS]
    assert not strange


def test_pages_that_code_names_exist():
    missing = []
    for path in (each for kind in KINDS for each in (ROOT / kind).rglob("*")):
        if path.suffix in {".py", ".yaml", ".md", ".j2"}:
            named = re.findall(r"\bdocs/[\w/-]+\.md\b", path.read_text(encoding="utf-8"))
            missing += [
                f"{path.relative_to(ROOT)}: {name}" for name in named if not (ROOT / name).is_file()
            ]
    assert not missing


def test_the_index_and_the_site_have_every_page_once():
    docs, index = ROOT / "docs", ROOT / "docs" / "README.md"
    listed = {(docs / target).resolve() for target, _ in LINK.findall(PAGES[index])}
    assert listed == {*DOCS, *docs.rglob("*.ipynb")} - {index}
    nav = re.findall(
        r"^ +- (?:.+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert sorted(nav) == sorted(
        {path.relative_to(docs).as_posix() for path in DOCS} - {"README.md"}
        | set(docs_site.pages())
    )


def test_commands_that_are_named_exist():
    """Commands within a sentence, often not whole; tests/integration/test_documentation.py reads the others."""
    strange = []
    for page, text in PAGES.items():
        sentences = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
        for command in re.findall(r"`((?:erfsfm|erfsfm-slam) [^`]+)`", sentences):
            program, *words = shlex.split(command.replace("[", "").replace("]", ""))
            verb = PROGRAMS[program]
            while words and words[0] in getattr(verb, "commands", {}):
                verb = verb.commands[words.pop(0)]
            known = {name for parameter in verb.params for name in parameter.opts} | {"--help"}
            if {word for word in words if re.match("--?[a-z]", word)} - known or (
                hasattr(verb, "commands") and words and not words[0].startswith("-")
            ):
                strange.append(f"{page.name}: {command}")
    assert not strange
