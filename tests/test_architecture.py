"""Rules of the house that neither ruff, mypy nor lint-imports can check."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import erfsfm
import slam
from erfsfm.config import load_experiment
from erfsfm.data.split_file import read_split_file
from slam.config.sections import load_config

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("erfsfm", "slam")
SOURCES = sorted(path for part in (*PACKAGES, "tools") for path in (ROOT / part).rglob("*.py"))
MODULES = [path for path in SOURCES if path.relative_to(ROOT).parts[0] in PACKAGES]
CONFIGS = sorted((ROOT / "configs").rglob("*.yaml"))
LOADERS: dict[str, Callable[[str], object]] = {
    "erfsfm": load_experiment,
    "slam": load_config,
    "splits": read_split_file,
}
MOST_LINES = 350
MOST_FUNCTION_LINES = 60
MOST_PARAMETERS = 9

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = Function | ast.ClassDef


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def definitions(tree: ast.Module) -> Iterator[Definition]:
    """Public functions and classes of a module, and the public methods of those classes."""
    for node in tree.body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                yield from (m for m in node.body if isinstance(m, Definition) and not m.name.startswith("_"))


def imports(tree: ast.Module) -> Iterator[str]:
    """Every module that is imported anywhere in a module, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


def uses(*libraries: str) -> set[str]:
    """Files of both packages that import one of these libraries."""
    found = set()
    for path in MODULES:
        if {module.partition(".")[0] for module in imports(ast.parse(path.read_text()))} & set(libraries):
            found.add(name_of(path))
    return found


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_every_module_and_public_name_says_what_it_is(path: Path) -> None:
    tree = ast.parse(path.read_text())
    silent = [node.name for node in definitions(tree) if not ast.get_docstring(node)]
    assert ast.get_docstring(tree) and not silent


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_a_file_is_short_enough_to_be_read(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MOST_LINES


def functions(tree: ast.AST, within: str = "") -> Iterator[tuple[str, Function]]:
    """Every function of a module with its qualified name, methods and nested functions too."""
    for node in ast.iter_child_nodes(tree):
        name = within
        if isinstance(node, Definition):
            name = f"{within}.{node.name}".lstrip(".")
            if isinstance(node, Function):
                yield name, node
        yield from functions(node, name)


def parameters(function: Function) -> int:
    """How many parameters a caller may give: all but the ``self`` or ``cls`` of a method."""
    given = function.args
    names = [
        each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg) if each
    ]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def is_verb(function: Function) -> bool:
    """Whether typer calls it: the parameters of a command-line verb are its options."""
    return any("command(" in ast.unparse(decorator) for decorator in function.decorator_list)


def test_functions_are_short_and_take_few_parameters() -> None:
    over = {}
    for path in SOURCES:
        for name, function in functions(ast.parse(path.read_text())):
            lines = (function.end_lineno or 0) - function.lineno + 1
            given = 0 if is_verb(function) else parameters(function)
            if lines > MOST_FUNCTION_LINES or given > MOST_PARAMETERS:
                over[f"{name_of(path)}:{name}"] = f"{lines} lines, {given} parameters"
    assert not over, f"split them: at most {MOST_FUNCTION_LINES} lines and {MOST_PARAMETERS} parameters; {over}"


def test_only_command_lines_and_tools_print() -> None:
    calls = {
        name_of(path)
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert calls <= {"erfsfm/cli.py", "slam/commands/cli.py"}


def test_each_heavy_library_has_one_home() -> None:
    assert uses("gtsam") == {"slam/graph/pose_graph.py", "slam/graph/similarity_graph.py"}
    assert uses("evo") == {"slam/evaluation/trajectory.py"}
    assert uses("open3d") == set()  # through the door of slam/runtime/imports.py
    assert all(name.startswith("erfsfm/training/") for name in uses("lightning"))
    assert not [name for name in uses("torch") if name.startswith("slam/")]


def test_no_module_is_named_like_one_of_python() -> None:
    """Run as a file, a package's folder comes first on the path: its ``types.py`` would be everybody's."""
    names = {path.stem for path in SOURCES if path.stem not in ("__init__", "__main__")}
    assert not names & set(sys.stdlib_module_names)


def test_both_packages_are_of_one_distribution_and_one_place() -> None:
    """Other distributions ship a package ``slam`` too; pip would merge them without a word."""
    assert erfsfm.DISTRIBUTION == slam.DISTRIBUTION == "erfsfm-slam"
    assert erfsfm.__file__ is not None and slam.__file__ is not None
    assert Path(erfsfm.__file__).parents[1] == Path(slam.__file__).parents[1]


def test_every_folder_of_modules_is_a_package() -> None:
    """Without ``__init__.py`` a folder imports well enough, but import contracts do not see it."""
    assert not [name_of(path.parent) for path in MODULES if not (path.parent / "__init__.py").is_file()]


def test_git_ignores_no_source() -> None:
    """A pattern such as ``results/`` would also keep ``slam/results/`` out of commits and out of the wheel."""
    names = "\n".join(map(name_of, SOURCES))
    command = ["git", "check-ignore", "--no-index", "--stdin"]
    listed = subprocess.run(command, cwd=ROOT, input=names, capture_output=True, text=True, check=False)
    if listed.returncode == 128:
        pytest.skip("not a git checkout")
    assert listed.stdout == ""


def test_tests_shadow_no_package() -> None:
    assert not list((ROOT / "tests").rglob("__init__.py"))


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_every_configuration_loads_by_file_and_by_name(path: Path) -> None:
    load = LOADERS[path.parent.name]
    assert load(str(path)) == load(path.stem)


def test_there_are_configurations_of_every_kind() -> None:
    assert {path.parent.name for path in CONFIGS} == set(LOADERS)


def test_no_tracked_text_names_a_place_on_one_machine() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    somewhere = re.compile(r"(?<![\w.$}])/(?:work|home|root|Users|mnt)/[\w.-]+")
    found = []
    for name in filter(None, listed.stdout.decode().split("\0")):
        try:
            text = (ROOT / name).read_text(encoding="utf-8")
        except (UnicodeDecodeError, FileNotFoundError):
            continue
        found += [f"{name}: {match}" for match in somewhere.findall(text)]
    assert not found
