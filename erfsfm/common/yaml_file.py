"""The YAML loader of both packages: no code, no duplicate keys, errors in one line."""

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
        YamlError: missing, too large, not YAML, or a duplicate key; one line.
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
    except (
        ValueError,
        TypeError,
        RecursionError,
    ) as error:  # a date that does not exist, a list for a key, endless lists
        raise YamlError(str(error)) from error


class _Loader(yaml.SafeLoader):
    """Safe YAML where ``1e-4`` is a number, and duplicate keys are refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As the parent class, refusing duplicate keys."""
        keys = [key.value for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.MarkedYAMLError(problem=f"duplicate key '{key}'", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


# PyYAML follows YAML 1.1, where a float needs a dot
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)
