"""Configurations of both packages: YAML files and ``section.key=value`` overrides, validated by a pydantic model."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from erfsfm.common.errors import ConfigError, ErfsfmError
from erfsfm.common.files import read_text

M = TypeVar("M", bound=BaseModel)
MAX_BYTES = 2**18
_WIDTH = 10_000  # of a line: no text is broken


class Section(BaseModel):
    """A frozen group of settings that refuses unknown keys and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def load_config(
    model: type[M],
    file_or_name: str | Path | None,
    overrides: Sequence[str],
    shipped: Sequence[Path],
) -> M:
    """Read a YAML file, or one of the ``shipped`` folders by its name; None for the defaults of the ``model``.

    Overrides are ``section.key=value``, the value in YAML; of two folders and of two overrides the first and the last
    one counts. What is wrong is one line that names the key, where it is from, what came and what is allowed.

    Args:
        model: the settings, with their defaults and bounds.
        file_or_name: a YAML file, or the name of a shipped one.
        overrides: ``section.key=value`` each.
        shipped: folders of YAML files that are known by name.

    Raises:
        ConfigError: no such file or name, no YAML of sections, an unknown key, or a value out of
            bounds.
    """
    tree: dict[str, Any] = {}
    origin = "the defaults"
    if file_or_name is not None:
        path = find_config(file_or_name, shipped)
        origin, tree = str(path), read_yaml(path) or {}
        if not isinstance(tree, dict):
            raise ConfigError(
                f"{path} must hold sections of keys; got {type(tree).__name__} {_shown(tree)}"
            )
    for text in overrides:
        _override(tree, text)
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_one_line(error, model, origin, overrides)) from error


def find_config(file_or_name: str | Path, shipped: Sequence[Path]) -> Path:
    """The YAML file of a path or of a shipped name.

    Raises:
        ConfigError: it is a folder, or neither a file nor a shipped name.
    """
    path = Path(file_or_name)
    if path.is_file():
        return path
    known: dict[str, Path] = {}
    for folder in reversed(shipped):
        for file in sorted(folder.glob("*.yaml")):
            known[file.stem] = file
    if str(file_or_name) in known:
        return known[str(file_or_name)]
    if path.is_dir():
        raise ConfigError(f"configuration '{file_or_name}' is a folder, not a YAML file")
    begun = [name for name in sorted(known) if name.startswith(path.stem)]  # "table1" begins many
    without_variants = [name for name in sorted(known) if "-" not in name]
    names = ", ".join(begun or without_variants) or "none"
    raise ConfigError(f"no configuration file or name '{file_or_name}' (known names: {names})")


def read_model(model: type[M], path: Path, error: type[ErfsfmError], wrong: str) -> M:
    """A small YAML file that has no overrides; an ``error`` of one line says what is ``wrong`` with it.

    Args:
        model: what the file holds.
        path: of the file.
        error: class of the error.
        wrong: what follows the path in its message.

    Raises:
        error: the file cannot be read, is not YAML, or does not fit the model.
    """
    try:
        return model.model_validate(read_yaml(path) or {})
    except YamlError as problem:
        raise error(str(problem)) from problem
    except ValidationError as problem:
        raise error(f"{path} {wrong}: {first_problem(problem)}") from problem


def dump_yaml(config: BaseModel) -> str:
    """The configuration as YAML that reads back to an equal configuration."""
    content = config.model_dump(mode="json")
    text: str = yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=_WIDTH)
    return text


def dump_explained(config: BaseModel) -> str:
    """As `dump_yaml`, with the description of every key as a comment; sections without nested sections only."""
    lines: list[str] = []
    for name, section in config:
        summary = (type(section).__doc__ or "").partition("\n")[0].rstrip(".").replace("``", "")
        lines += [*([""] if lines else []), f"{name}:  # {summary}"]
        for key, value in section.model_dump(mode="json").items():
            text = (
                yaml.dump(value, Dumper=_Dumper, default_flow_style=True, width=_WIDTH)
                .removesuffix("...\n")
                .strip()
            )
            lines.append(f"  {key}: {text}  # {type(section).model_fields[key].description}")
    return "\n".join(lines) + "\n"


def first_problem(error: ValidationError) -> str:
    """The first problem of a validation error as ``key: problem``, for small files that have no overrides."""
    first = error.errors(include_url=False)[0]
    place = ".".join(map(str, first["loc"]))
    in_short = {"missing": "missing", "extra_forbidden": "unknown key"}
    said = in_short.get(first["type"], first["msg"].removeprefix("Value error, "))
    return f"{place}: {said}" if place else said


def _override(tree: dict[str, Any], text: str) -> None:
    dotted, equals, written = str(text).partition("=")
    parts = dotted.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(f"--set needs section.key=value; got '{text}'")
    try:
        value = parse_yaml(written)
    except YamlError as error:
        raise ConfigError(f"the value of --set {text} is not YAML: {error}") from error
    for part in parts[:-1]:
        section = tree.get(part, {})
        if not isinstance(section, dict):
            raise ConfigError(f"--set {text}: '{part}' is not a section")
        tree = tree.setdefault(part, section)
    tree[parts[-1]] = value


def _one_line(
    error: ValidationError, model: type[BaseModel], origin: str, overrides: Sequence[str]
) -> str:
    first = error.errors(include_url=False)[0]
    known = list(_known_keys(model))
    place = ".".join(map(str, first["loc"]))
    origin = _origin(place, origin, overrides)
    if first["type"] == "extra_forbidden":
        return f"unknown key '{place}' in {origin}; {_nearest_key(place, known)}"
    # pydantic appends the branch of a union, or the place inside a value
    key = max((name for name in known if f"{place}.".startswith(f"{name}.")), key=len, default="")
    is_section = first["type"] == "model_type"
    wanted = (
        "a section"
        if is_section
        else first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    )
    return (
        f"'{key}' in {origin} should be {wanted}; got {_shown(first['input'])}"
        if key
        else f"{origin}: {wanted}"
    )


def _origin(place: str, origin: str, overrides: Sequence[str]) -> str:
    """The last override of a key, of the section it is in, or of what is in it; else where the tree came from."""
    for text in reversed(overrides):
        key = text.partition("=")[0].strip()
        if f"{place}.".startswith(f"{key}.") or f"{key}.".startswith(f"{place}."):
            return f"--set {text}"
    return origin


def _nearest_key(key: str, known: Sequence[str]) -> str:
    section, _, last = key.rpartition(".")
    siblings = [name for name in known if name.rpartition(".")[0] == section]
    last_words = {}
    for name in (*reversed(known), *siblings):  # siblings first
        last_words[name.rpartition(".")[2]] = name
    if nearest := difflib.get_close_matches(last, last_words, 1, 0.7):
        return f"did you mean '{last_words[nearest[0]]}'?"
    return f"known keys{f' of {section}' if section else ''}: {', '.join(siblings)}"


def _known_keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, declared in model.model_fields.items():
        yield prefix + name
        if isinstance(declared.annotation, type) and issubclass(declared.annotation, BaseModel):
            yield from _known_keys(declared.annotation, f"{prefix}{name}.")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


class YamlError(ConfigError):
    """Text or a file is not YAML that this project reads."""


def read_yaml(path: Path) -> Any:
    """The content of a YAML file; None where it is empty.

    Raises:
        YamlError: there is no such file, or it cannot be read, or it is not YAML.
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
        YamlError: the text is not YAML, or a mapping has a key twice.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        problem, mark = (
            getattr(error, "problem", None) or str(error),
            getattr(error, "problem_mark", None),
        )
        raise YamlError(f"{problem} (line {mark.line + 1})" if mark else problem) from error
    except (
        ValueError,
        TypeError,
        RecursionError,
    ) as error:  # no date, a list for a key, endless lists
        raise YamlError(str(error)) from error


class _Loader(yaml.SafeLoader):
    """Safe YAML where ``1e-4`` is a number, and duplicate keys are refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As the parent class, refusing duplicate keys."""
        keys = [key.value for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.MarkedYAMLError(
                    problem=f"duplicate key '{key}'", problem_mark=node.start_mark
                )
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Writes text that `_Loader` would take for a number in quotes, be it the commit 8e4572260207."""


# PyYAML follows YAML 1.1, where a float needs a dot
for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
        list("-+.0123456789"),
    )
