"""Write docs/settings.md: every setting of a run and of a training, from their typed configurations.

Example: python tools/settings_page.py
"""

from __future__ import annotations

import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from shared.command import parser_of

from erfsfm.common.files import write_atomically
from erfsfm.config import ExperimentConfig
from slam.config.sections import SlamConfig

INTRODUCTION = """# Settings

`--set section.key=value` changes a setting; the option may be repeated, and the value is YAML. `--config FILE` reads a
YAML file of sections and keys; a key that is not in the file has its default. Unknown keys are refused.
`tools/settings_page.py` writes this page.

"""
RUN = """## Run
Settings of `erfsfm-slam run`, `live`, `batch` and `slam.Slam`. `erfsfm-slam config` prints them as a YAML file.

"""
TRAINING = """## Training
Settings of `erfsfm train`. `configs/erfsfm/` holds complete experiments; `--config NAME` takes one of them.

"""
WORDS = {str: "text", int: "integer", float: "number", bool: "true or false", Path: "path"}
BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
HEADER = "| setting | values | default | meaning |\n|---|---|---|---|\n"


def main() -> None:
    """Write the page."""
    parser = parser_of(__doc__)
    parser.add_argument("--output", type=Path, default=Path("docs/settings.md"), help="the page to write")
    output: Path = parser.parse_args().output
    write_atomically(output, lambda path: path.write_text(page(), encoding="utf-8"))


def page() -> str:
    """The whole page in Markdown."""
    run, training = ("\n".join(sections(config)) for config in (SlamConfig(), ExperimentConfig()))
    return f"{INTRODUCTION}{RUN}{run}\n{TRAINING}{training}"


def sections(config: BaseModel) -> Iterator[str]:
    """A heading and a table for each section; the settings outside of sections come last."""
    single = []
    for name, declared in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            rows = [row(f"{name}.{key}", field, value) for key, field in type(value).model_fields.items()]
            yield f"### {name}\n{summary(value)}\n\n{HEADER}{''.join(rows)}"
        else:
            single.append(row(name, declared, config))
    if single:
        yield f"### Outside of sections\n\n{HEADER}{''.join(single)}"


def summary(section: BaseModel) -> str:
    """The first line of a section's docstring, with its page as a link."""
    first = (type(section).__doc__ or "").partition("\n")[0].replace("``", "`")
    return re.sub(r"`docs/([\w/-]+)\.md`", r"[\1](\1.md)", first)


def row(key: str, field: FieldInfo, section: BaseModel) -> str:
    """One line of a table."""
    last = key.rpartition(".")[2]
    default = yaml.safe_dump(section.model_dump(mode="json")[last], default_flow_style=True, width=10_000)
    shown = default.removesuffix("...\n").strip()
    limits = [(sign, getattr(limit, name, None)) for limit in field.metadata for name, sign in BOUNDS.items()]
    bounds = [f"{sign} {number}" for sign, number in limits if number is not None]
    values = ", ".join([kind(field.annotation), *bounds])
    return f"| `{key}` | {values} | `{shown}` | {field.description} |\n"


def kind(annotation: Any) -> str:
    """The values of a type, in words."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return kind(inner[0])
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner)
    if origin in (Union, types.UnionType):
        return " or ".join("null" if part is type(None) else kind(part) for part in inner)
    if origin is tuple:
        return f"{len(inner)} values: {kind(inner[0])}"
    if origin is list:
        return f"list: {kind(inner[0])}"
    if origin is dict:
        return f"mapping: {kind(inner[0])} to {kind(inner[1])}"
    return WORDS[annotation]


if __name__ == "__main__":
    main()
