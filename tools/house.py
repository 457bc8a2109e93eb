"""Compare the code with its limits, ``[tool.house]`` of pyproject.toml; exit code 1 where one is passed.

Code is counted in tokens of Python, without comments, docstrings, imports and line ends: neither a
line break nor an explanation costs anything, and packing lines saves nothing.

Example: python tools/house.py
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from shared.command import parser_of

ROOT = Path(__file__).parents[1]
PACKAGES = ("slam", "erfsfm", "tools", "tests")
SETTINGS = ("slam/config/sections.py", "erfsfm/config.py")
LONG_LINE = 100  # columns
NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.ENCODING,
}
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
Comprehension = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp


def main() -> None:
    """Print each count beside its limit, and end with the limits that are passed."""
    parser_of(__doc__).parse_args()
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    limits: dict[str, float] = tomllib.loads(text)["tool"]["house"]
    found = counts()
    for name, limit in limits.items():
        print(f"{name:20} {found[name]:10,g} of {limit:,}")
    over = [name for name, limit in limits.items() if found[name] > limit]
    if over:
        sys.exit(f"over the limits of the house: {', '.join(over)}; take something out first")


def counts() -> dict[str, float]:
    """What each limit counts, by its name.

    ``comprehensions`` are counted a 1,000 lines of code and ``long_lines`` in percent of all lines,
    both without the tests.
    """
    counted: Counter[str] = Counter()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            tree = ast.parse(text)
            lines = lines_of_tokens(text, tree)
            counted[package] += len(lines)
            if package == "tests":
                continue
            nodes = list(ast.walk(tree))
            counted["files"] += package != "tools"
            counted["largest_file"] = max(counted["largest_file"], len(lines))
            counted["dataclasses"] += package == "slam" and sum(map(is_dataclass, nodes))
            counted["comprehensions"] += sum(isinstance(node, Comprehension) for node in nodes)
            counted["late_constants"] += sum(1 for _ in late_constants(tree))
            counted["lines_of_code"] += len(set(lines))
            counted["lines"] += text.count("\n")
            counted["long_lines"] += sum(len(line) > LONG_LINE for line in text.splitlines())
            if path.relative_to(ROOT).as_posix() in SETTINGS:
                counted["settings"] += settings(tree)
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    per_1000 = 1000 * counted["comprehensions"] / counted["lines_of_code"]
    return {
        **counted,
        "comprehensions": round(per_1000, 1),
        "long_lines": round(100 * counted["long_lines"] / counted["lines"], 1),
        "documents": sum(path.read_text(encoding="utf-8").count("\n") for path in documents),
    }


def lines_of_tokens(text: str, tree: ast.Module) -> list[int]:
    """The line on which each token of code begins."""
    left_out: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            left_out.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        if isinstance(node, ast.Module | Definition) and ast.get_docstring(node) is not None:
            docstring = node.body[0]
            left_out.update(range(docstring.lineno, (docstring.end_lineno or docstring.lineno) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    starts = [token.start[0] for token in tokens if token.type not in NOT_CODE]
    return [line for line in starts if line not in left_out]


def late_constants(tree: ast.Module) -> Iterator[int]:
    """Lines of constants after the first definition of a file, but for those that use a definition."""
    defined: set[str] = set()
    for node in tree.body:
        if isinstance(node, Definition):
            defined.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign) and defined:
            used = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
            if not used & defined:
                yield node.lineno


def is_dataclass(node: ast.AST) -> bool:
    """Whether a node is a class with the decorator ``dataclass``."""
    return isinstance(node, ast.ClassDef) and any(
        "dataclass" in ast.unparse(decorator) for decorator in node.decorator_list
    )


def settings(tree: ast.Module) -> int:
    """How many fields the classes of a module of settings have."""
    classes = (node for node in tree.body if isinstance(node, ast.ClassDef))
    return sum(isinstance(field, ast.AnnAssign) for node in classes for field in node.body)


if __name__ == "__main__":
    main()
