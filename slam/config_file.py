"""Configuration files as trees of keys: found by path or by name, read strictly, changed key by key."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Any

import yaml

from slam.errors import ConfigError


def read_tree(file_or_name: str | Path) -> dict[str, Any]:
    """The sections of a YAML file, or of one of those under ``configs/slam`` by its name.

    Raises:
        ConfigError: no such file or name, or not sections in YAML.
    """
    path = _find(file_or_name)
    try:
        tree = _parse(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {_yaml_problem(error)}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path} must hold sections of keys; got {type(tree).__name__} {tree!r:.60}")
    return tree


def override(tree: dict[str, Any], text: str) -> None:
    """Change one key of a tree by ``section.key=value``, the value in YAML.

    Raises:
        ConfigError: the text is no override, or goes through a key that is no section.
    """
    dotted, equals, written = text.partition("=")
    parts = dotted.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(f"an override is written section.key=value; got '{text}'")
    try:
        value = _parse(written)
    except yaml.YAMLError as error:
        raise ConfigError(f"the value of '{text}' is not valid YAML: {_yaml_problem(error)}") from error
    for part in parts[:-1]:
        tree = tree.setdefault(part, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"'{text}': '{part}' is not a section")
    tree[parts[-1]] = value


class _Loader(yaml.SafeLoader):
    """Safe YAML where ``1e-4`` is a number and a key may stand once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As the parent, refusing duplicate keys."""
        keys = [key.value for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.MarkedYAMLError(problem=f"key {key!r} stands twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


# PyYAML follows YAML 1.1, where a float needs a dot
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def _find(file_or_name: str | Path) -> Path:
    path = Path(file_or_name)
    if path.is_file():
        return path
    here = Path(__file__).resolve().parent
    folders = [here.parent / "configs" / "slam", here / "_configs"]
    known = {file.stem: file for folder in reversed(folders) for file in sorted(folder.glob("*.yaml"))}
    if str(file_or_name) in known:
        return known[str(file_or_name)]
    if path.is_dir():
        raise ConfigError(f"configuration '{file_or_name}' is a folder, not a YAML file")
    nearest = difflib.get_close_matches(path.stem, known, 1)
    hint = f"; did you mean '{nearest[0]}'?" if nearest else ""
    names = ", ".join(sorted(known)) or "none"
    raise ConfigError(f"no configuration file or name '{file_or_name}' (known names: {names}){hint}")


def _parse(text: str) -> Any:
    return yaml.load(text, Loader=_Loader)


def _yaml_problem(error: yaml.YAMLError) -> str:
    problem = getattr(error, "problem", None) or " ".join(str(error).split())
    mark = getattr(error, "problem_mark", None)
    return f"{problem} (line {mark.line + 1})" if mark else str(problem)
