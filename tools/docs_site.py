"""Build the documentation site: the pages of docs/, those that are elsewhere, and those made from the code.

Every link is checked. `make docs` installs MkDocs and calls this; MkDocs finds its hooks here.

Example: python tools/docs_site.py --output site
"""

from __future__ import annotations

import json
import os
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
import typer.cli
from shared.command import parser_of

import erfsfm.cli
import slam.commands.cli

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = "default", "sim", "erf-dfc", "erf-dfcv2", "fusion"
# files of the repository whose page is not where the file is in docs/
PLACES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "docs/README.md": "pages.md",
    "docs/first-steps.ipynb": "first-steps.md",
    **{f"erfsfm/weights/{name}/README.md": f"weights/{name}.md" for name in WEIGHTS},
}
SOURCES = {place: source for source, place in PLACES.items()}
LINK = re.compile(r"\]\((?![a-z]+:|#)([^)\s#]+)")
PROGRAMS = {"erfsfm-slam": slam.commands.cli.app, "erfsfm": erfsfm.cli.app}
# public names by the module to import them from
INTERFACE = {
    "slam": ("run_slam", "Slam", "RunFolder"),
    "slam.commands.run": ("RunRequest",),
    "slam.config.sections": ("load_config",),
    "slam.formats.trajectory": ("Trajectory", "read_trajectory", "write_kitti", "write_tum"),
    "slam.evaluation.trajectory": ("trajectory_metrics", "align"),
    "slam.pipeline.live": ("LivePose",),
    "slam.frames": (
        "Intrinsics",
        "Frame",
        "Sequence",
        "Predictor",
        "SnippetPoses",
        "RelativePose",
        "View",
    ),
    "slam.sequences.catalogue": ("open_sequence",),
    "slam.sequences.recording": ("RecordedSequence", "Source"),
    "slam.sequences.loader": ("Loader",),
    "slam.prediction.depth_source": ("DepthSource",),
    "erfsfm.inference": ("DepthPosePredictor",),
}
# of names that have other members for the program itself
MEMBERS = {
    "RunFolder": ["open", "metrics", "trajectory", "mesh", "cloud", "keyframes"],
    "RunRequest": [],
}


def main() -> None:
    """Build the site; a warning ends with exit code 1."""
    parser = parser_of(__doc__)
    parser.add_argument("--output", type=Path, default=Path("site"), help="the folder to write")
    output: Path = parser.parse_args().output
    os.environ.setdefault(
        "NO_MKDOCS_2_WARNING", "1"
    )  # about versions that constraints.txt rules out
    try:
        from mkdocs.__main__ import cli
    except ModuleNotFoundError as error:
        raise SystemExit(f"{error.name} is not installed: run make docs") from error
    cli(
        [
            "build",
            "--strict",
            "--config-file",
            str(ROOT / "mkdocs.yml"),
            "--site-dir",
            str(output.resolve()),
        ]
    )


def on_config(config: MkDocsConfig) -> None:
    """Anchors of headings as on GitHub."""
    from pymdownx.slugs import slugify

    config.mdx_configs.setdefault("toc", {})["slugify"] = slugify(case="lower")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that are not in docs/."""
    from mkdocs.structure.files import File

    if (index := files.get_file_from_path("README.md")) is not None:
        files.remove(index)
    for place, text in pages().items():
        files.append(File.generated(config, place, content=text))


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Links from file to file of the repository as links from page to page."""
    place = page.file.src_uri
    source = SOURCES.get(place, f"docs/{place}")

    def link(found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), found[1]))
        wanted = PLACES.get(target, target.removeprefix("docs/"))
        return "](" + posixpath.relpath(wanted, posixpath.dirname(place) or ".")

    return LINK.sub(link, markdown)


def pages() -> dict[str, str]:
    """The Markdown of the pages that are not in docs/, by their place in the site."""
    elsewhere = {}
    for source, place in PLACES.items():
        elsewhere[place] = text = (ROOT / source).read_text(encoding="utf-8")
        if source.endswith(".ipynb"):
            cells = [
                (cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]
            ]
            parts = [
                text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in cells
            ]
            elsewhere[place] = "\n\n".join(parts)
    return elsewhere | {"command-line.md": command_line(), "python.md": interface()}


def command_line() -> str:
    """Every verb of both programs with its options, as ``--help`` prints them."""
    text = "# Command line\n\n"
    for name, app in PROGRAMS.items():
        command = typer.main.get_command(app)
        text += (
            typer.cli.get_docs_for_click(
                obj=command, ctx=typer.Context(command), name=name, indent=1
            )
            + "\n"
        )
    text = re.sub(r"\*\*Commands\*\*:\n\n(\* .*\n)+|\* `--help`: .*\n", "", text)
    text = re.sub(r"^Example: (.+)$", r"```sh\n\1\n```", text, flags=re.MULTILINE)
    text = re.sub(
        r"(```.*?```|`[^`\n]*`)|<", lambda found: found[1] or "&lt;", text, flags=re.DOTALL
    )
    return re.sub(r"docs/([\w/-]+)\.md", r"[\1](\1.md)", text)


def interface() -> str:
    """The public names of both packages; mkdocstrings puts their docstrings there."""
    text = "# Python\n"
    for module, names in INTERFACE.items():
        text += f"\n## `{module}`\n"
        for name in names:
            options = f"    options: {{members: {MEMBERS[name]}}}\n" if name in MEMBERS else ""
            text += f"\n::: {module}.{name}\n{options}"
    return text


if __name__ == "__main__":
    main()
