"""The documentation site is built without a warning, its links lead somewhere, it loads nothing from elsewhere."""

import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MKDOCS = ROOT / ".venv-docs"


class Html(HTMLParser):
    """Links, files to load, and anchors of a page; its text without code."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors = {""}
        self.text = ""
        self.inside: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = {name: value or "" for name, value in attrs}
        self.links += [names["href"]] if tag == "a" and "href" in names else []
        self.loaded += [names[key] for key in ("src", "href") if tag != "a" and key in names]
        self.anchors |= {names["id"]} if "id" in names else set()
        self.inside += [tag] if tag in ("code", "script", "style") else []

    def handle_endtag(self, tag: str) -> None:
        if self.inside[-1:] == [tag]:
            self.inside.pop()

    def handle_data(self, data: str) -> None:
        self.text += "" if self.inside else data


@pytest.mark.slow
@pytest.mark.skipif(
    not (MKDOCS.is_dir() or importlib.util.find_spec("mkdocs")), reason="make docs installs MkDocs, which is not here"
)
def test_the_site_is_whole(tmp_path: Path) -> None:
    paths = [str(ROOT), str(MKDOCS), os.environ.get("PYTHONPATH", "")]
    words = [sys.executable, str(ROOT / "tools/docs_site.py"), "--output", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    built = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    pages = {path: Html(path) for path in tmp_path.rglob("*.html") if path.name != "404.html"}
    for path, page in pages.items():
        assert not [each for each in page.loaded if "//" in each], path
        assert not re.search(r"\n[-|] |\*\*|\]\(", page.text), f"{path} shows Markdown that is not understood"
        for link in {*page.links, *page.loaded}:
            name, _, anchor = link.partition("#")
            target = (path.parent / name).resolve() if name else path
            assert "//" in name or target.exists(), f"{path}: {link}"
            assert target not in pages or anchor in pages[target].anchors, f"{path}: {link}"
    assert {"run_slam", "RunFolder", "DepthPosePredictor"} <= set(pages[tmp_path / "python.html"].text.split())
    assert "erfsfm-slam-run" in pages[tmp_path / "command-line.html"].anchors
