"""The YAML loader of both packages: no code, no aliases, no duplicate keys, errors in one line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.files import read_text

MAX_BYTES = 2**18


class YamlError(ErfsfmError):
    """Text or a file is not YAML that this project reads."""


def read_yaml(path: Path) -> Any:
    """The content of a YAML file; None where it is empty.

    Raises:
        YamlError: missing, too large, not YAML, an alias or a duplicate key; one line.
    """
    if not path.is_file():
        raise YamlError(f"{path} is not there, or not a file")
    try:
        return parse_yaml(read_text(path, "utf-8", MAX_BYTES))
    except OSError as error:
        raise YamlError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise YamlError(f"{path} is not YAML: it is not UTF-8 text") from error
    except YamlError as error:
        raise YamlError(f"{path} is not YAML: {error}") from error


def parse_yaml(text: str) -> Any:
    """The value of a YAML text.

    Raises:
        YamlError: the problem and its line, in one line.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        problem, mark = getattr(error, "problem", None) or str(error), getattr(error, "problem_mark", None)
        raise YamlError(f"{problem} (line {mark.line + 1})" if mark else problem) from error
    except (ValueError, OverflowError, RecursionError) as error:  # a date or number that does not exist, endless lists
        raise YamlError(str(error)) from error


class _Loader(yaml.SafeLoader):
    """Safe YAML where ``1e-4`` is a number, and aliases and duplicate keys are refused."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As the parent class, without aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(problem="an alias: write it out", problem_mark=self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As the parent class, refusing duplicate keys."""
        keys: set[tuple[str, str]] = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if (key.tag, key.value) in keys:
                raise yaml.MarkedYAMLError(problem=f"duplicate key '{key.value}'", problem_mark=key.start_mark)
            keys.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


# PyYAML follows YAML 1.1, where a float needs a dot
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)
