"""Write docs/settings.md: every setting of a run and of a training, from their typed configurations.

Example: python tools/settings_page.py
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel
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
# types, formats and bounds of a JSON schema
WORDS = {
    "string": "text",
    "integer": "integer",
    "number": "number",
    "boolean": "true or false",
    "path": "path",
}
WORDS |= {"null": "null"}
BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
HEADER = "| setting | values | default | meaning |\n|---|---|---|---|\n"


def main() -> None:
    """Write the page."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--output", type=Path, default=Path("docs/settings.md"), help="the page to write"
    )
    output: Path = parser.parse_args().output
    write_atomically(output, page())


def page() -> str:
    """The whole page in Markdown."""
    run, training = ("\n".join(sections(config)) for config in (SlamConfig(), ExperimentConfig()))
    return f"{INTRODUCTION}{RUN}{run}\n{TRAINING}{training}"


def sections(config: BaseModel) -> Iterator[str]:
    """A heading and a table for each section; the settings outside of sections come last."""
    for name, value in config:
        if isinstance(value, BaseModel):
            yield f"### {name}\n{summary(value)}\n\n{table(value, f'{name}.', list(type(value).model_fields))}"
    single = [name for name, value in config if not isinstance(value, BaseModel)]
    if single:
        yield f"### Outside of sections\n\n{table(config, '', single)}"


def summary(section: BaseModel) -> str:
    """The first line of a section's docstring, with its page as a link."""
    first = (type(section).__doc__ or "").partition("\n")[0].replace("``", "`")
    return re.sub(r"`docs/([\w/-]+)\.md`", r"[\1](\1.md)", first)


def table(section: BaseModel, prefix: str, keys: list[str]) -> str:
    """A line for each of these settings of a section, by its JSON schema."""
    schema, defaults = (
        type(section).model_json_schema()["properties"],
        section.model_dump(mode="json"),
    )
    text = HEADER
    for key in keys:
        default = (
            yaml.safe_dump(defaults[key], default_flow_style=True, width=10_000)
            .removesuffix("...\n")
            .strip()
        )
        limited = schema[key].get("anyOf", [schema[key]])[0]  # of an optional number
        values = ", ".join(
            [kind(schema[key]), *(f"{BOUNDS[b]} {limited[b]}" for b in BOUNDS if b in limited)]
        )
        text += f"| `{prefix}{key}` | {values} | `{default}` | {schema[key]['description']} |\n"
    return text


def kind(schema: dict[str, Any]) -> str:
    """The values of a JSON schema, in words."""
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum") or [schema["const"]])
    if "anyOf" in schema:
        return " or ".join(map(kind, schema["anyOf"]))
    if "prefixItems" in schema:
        return f"{len(schema['prefixItems'])} values: {kind(schema['prefixItems'][0])}"
    if schema["type"] == "array":
        return f"list: {kind(schema['items'])}"
    if schema["type"] == "object":
        return f"mapping: text to {kind(schema['additionalProperties'])}"
    return WORDS[schema.get("format", schema["type"])]


if __name__ == "__main__":
    main()
