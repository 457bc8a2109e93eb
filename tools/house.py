"""Compare the size of the tree with its budget, ``[tool.house]`` of pyproject.toml; exit code 1 where it is larger.

Example: python tools/house.py
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

from shared.command import parser_of

ROOT = Path(__file__).parents[1]


def sizes() -> dict[str, int]:
    """Lines of Python by package, and how many files, dataclasses and lines of documents there are."""
    files = {name: sorted((ROOT / name).rglob("*.py")) for name in ("slam", "erfsfm", "tools", "tests")}
    texts = {name: [path.read_text(encoding="utf-8") for path in paths] for name, paths in files.items()}
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return {
        **{name: sum(len(text.splitlines()) for text in each) for name, each in texts.items()},
        "files": len(files["slam"]) + len(files["erfsfm"]),
        "dataclasses": sum(len(re.findall(r"^\s*@dataclass", text, re.MULTILINE)) for text in texts["slam"]),
        "documents": sum(len(path.read_text(encoding="utf-8").splitlines()) for path in documents),
    }


if __name__ == "__main__":
    parser_of(__doc__).parse_args()
    budget = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["house"]
    over = [f"{name} {size}, budget {budget[name]}" for name, size in sizes().items() if size > budget[name]]
    if over:
        sys.exit(f"over the budget: {'; '.join(over)}; merge or delete first")
