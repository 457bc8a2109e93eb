"""Rules of the house that neither ruff, mypy nor lint-imports can check: one walk over the tree each."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import erfsfm
import slam
from erfsfm.config import load_experiment
from erfsfm.data.split import read_split_file
from slam.config.sections import load_config

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("erfsfm", "slam")
SOURCES = {
    path.relative_to(ROOT).as_posix(): path.read_text()
    for part in (*PACKAGES, "tools")
    for path in sorted((ROOT / part).rglob("*.py"))
}
MODULES = [name for name in SOURCES if name.partition("/")[0] in PACKAGES]
LOADERS: dict[str, Callable[[str], object]] = {
    "erfsfm": load_experiment,
    "slam": load_config,
    "splits": read_split_file,
}
MOST_FUNCTION_LINES = 60  # after the docstring
MOST_PARAMETERS = 9

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = Function | ast.ClassDef


@functools.cache
def tree_of(name: str) -> ast.Module:
    return ast.parse(SOURCES[name])


@functools.cache
def nodes(name: str) -> list[ast.AST]:
    return list(ast.walk(tree_of(name)))


def public(body: list[ast.stmt]) -> Iterator[Definition]:
    """Public functions and classes, and the public methods of those classes."""
    for node in body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body)


def uses(*libraries: str) -> set[str]:
    """Files of both packages that import one of these libraries, also inside functions."""
    found = set()
    for name in MODULES:
        for node in nodes(name):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                modules = [node.module]
            if {module.partition(".")[0] for module in modules} & set(libraries):
                found.add(name)
    return found


def parameters(function: Function) -> int:
    """How many parameters a caller may give; those of a command-line verb are its options and do not count."""
    if any("command(" in ast.unparse(decorator) for decorator in function.decorator_list):
        return 0
    given = function.args
    every = (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg)
    return len([each for each in every if each is not None and each.arg not in ("self", "cls")])


def test_every_module_and_public_name_says_what_it_is():
    silent = [name for name in SOURCES if not ast.get_docstring(tree_of(name))]
    silent += [
        f"{name}:{node.name}"
        for name in SOURCES
        for node in public(tree_of(name).body)
        if not ast.get_docstring(node)
    ]
    assert not silent


def test_functions_are_short_and_take_few_parameters():
    over = set()
    for name in SOURCES:
        for node in nodes(name):
            if isinstance(node, Function):
                documented = ast.get_docstring(node) is not None and len(node.body) > 1
                lines = (node.end_lineno or 0) - node.body[documented].lineno + 1
                if lines > MOST_FUNCTION_LINES or parameters(node) > MOST_PARAMETERS:
                    over.add(f"{name}:{node.name}")
    assert not over


def test_only_command_lines_and_tools_print():
    calls = {
        name
        for name in MODULES
        for node in nodes(name)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    }
    assert calls <= {"erfsfm/cli.py", "slam/commands/cli.py"}


def test_each_heavy_library_has_one_home():
    assert uses("gtsam") == {"slam/graph/pose_graph.py"}
    assert uses("evo") == {"slam/evaluation/trajectory.py"}
    assert uses("open3d") == set()  # through the door of slam/runtime/imports.py
    assert all(name.startswith("erfsfm/training/") for name in uses("lightning"))
    assert not [name for name in uses("torch") if name.startswith("slam/")]


def test_no_module_is_named_like_one_of_python_and_every_folder_is_a_package():
    """Run as a file, a package's folder comes first on the path; contracts of imports do not see other folders."""
    names = {Path(name).stem for name in SOURCES} - {"__init__", "__main__"}
    assert not names & set(sys.stdlib_module_names)
    assert not [name for name in MODULES if not (ROOT / name).with_name("__init__.py").is_file()]
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_each_file_of_tests_mirrors_a_module():
    tests = ROOT / "tests"
    without_module = []
    for part in (*PACKAGES, "tools"):
        for path in sorted((tests / part).rglob("test_*.py")):
            module = path.with_name(path.name.removeprefix("test_")).relative_to(tests)
            if module.as_posix() not in SOURCES:
                without_module.append(f"{path.relative_to(ROOT)}: there is no {module}")
    assert not without_module, "\n".join(without_module)


def test_the_package_shows_its_doors_alone():
    assert {name for name in dir(slam) if not name.startswith("__")} == {
        "RunFolder",
        "Slam",
        "load_config",
        "run_slam",
    }


def test_both_packages_are_of_one_distribution_and_one_place():
    """Other distributions ship a package ``slam`` too; pip would merge them without a word."""
    assert erfsfm.DISTRIBUTION == slam.DISTRIBUTION == "erfsfm-slam"
    assert erfsfm.__file__ is not None and slam.__file__ is not None
    assert Path(erfsfm.__file__).parents[1] == Path(slam.__file__).parents[1]


def test_git_ignores_no_source():
    """A pattern such as ``results/`` would also keep ``slam/results/`` out of commits and out of the wheel."""
    command = ["git", "check-ignore", "--no-index", "--stdin"]
    listed = subprocess.run(
        command, cwd=ROOT, input="\n".join(SOURCES), capture_output=True, text=True, check=False
    )
    if listed.returncode == 128:
        pytest.skip("not a git checkout")
    assert listed.stdout == ""


def test_every_configuration_loads_by_file_and_by_name():
    files = list((ROOT / "configs").rglob("*.yaml"))
    assert {path.parent.name for path in files} == set(LOADERS)
    assert not [
        path
        for path in files
        if LOADERS[path.parent.name](str(path)) != LOADERS[path.parent.name](path.stem)
    ]


def test_no_tracked_text_names_a_place_on_one_machine():
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
