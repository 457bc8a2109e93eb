"""The YAML loader of both packages: no code, no aliases, no duplicate keys, errors in one line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from erfsfm.common.errors import ErfsfmError

MAX_BYTES = 256 * 1024


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
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise YamlError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise YamlError(f"{path} is larger than {MAX_BYTES // 1024} KiB: it is not one of this project's YAML files")
    try:
        return parse_yaml(content.decode("utf-8"))
    except (YamlError, UnicodeDecodeError) as error:
        problem = "it is not UTF-8 text" if isinstance(error, UnicodeDecodeError) else error
        raise YamlError(f"{path} is not YAML: {problem}") from error


def parse_yaml(text: str) -> Any:
    """The value of a YAML text.

    Raises:
        YamlError: the problem and its line, in one line.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        mark = getattr(error, "problem_mark", None)
        raise YamlError(f"{problem} (line {mark.line + 1})" if mark else str(problem)) from error
    except (ValueError, OverflowError) as error:  # a date or number of the right form that does not exist
        raise YamlError(" ".join(str(error).split())) from error
    except RecursionError as error:
        raise YamlError("lists within lists without end") from error


class _Loader(yaml.SafeLoader):
    """Safe YAML where ``1e-4`` is a number, and aliases and duplicate keys are refused."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As the parent class, without aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(problem="an alias: write it out", problem_mark=self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As the parent class, refusing duplicate keys."""
        seen: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if (key.tag, key.value) in seen:
                raise yaml.MarkedYAMLError(problem=f"duplicate key '{key.value}'", problem_mark=key.start_mark)
            seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


# PyYAML follows YAML 1.1, where a float needs a dot
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)
