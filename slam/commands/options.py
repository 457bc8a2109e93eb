"""Options that several verbs share, and verbs whose options are the fields of a record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, Field, fields
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer
from typer.models import OptionInfo

LARGEST_SEED = 2**31 - 1

Weights = Annotated[str, typer.Option(help="default, sim, erf-dfc, erf-dfcv2 or a training output")]
Config = Annotated[str | None, typer.Option(help="a YAML file or a shipped name")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")]
Output = Annotated[Path | None, typer.Option(help="the run folder; else results/<stamp>_<name>")]
Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="where the networks run")]
Seed = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="seed of every random draw")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of a table")]

# every verb that computes takes both; in one that draws nothing and runs no network they change nothing
UnusedDevice = Annotated[Literal["auto", "cpu", "cuda"], typer.Option("--device", hidden=True)]
UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True)]


def options_of(record: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a verb the options that the fields of a dataclass are annotated with.

    The verb is called with the record as its first argument, and with its own options.
    """
    hints = get_type_hints(record, include_extras=True)
    named = [each for each in fields(record) if _is_option(hints[each.name])]
    options = [Parameter(f.name, Parameter.KEYWORD_ONLY, default=_default(f), annotation=hints[f.name]) for f in named]

    def with_options(verb: Callable[..., None]) -> Callable[..., None]:
        def command(**given: Any) -> None:
            verb(record(**{each.name: given.pop(each.name) for each in named}), **given)

        _, *own = signature(verb, eval_str=True).parameters.values()
        own = [each.replace(kind=Parameter.KEYWORD_ONLY) for each in own]
        command.__name__, command.__doc__ = verb.__name__, verb.__doc__
        command.__signature__ = Signature([*options, *own])  # type: ignore[attr-defined]
        command.__annotations__ = {}
        return command

    return with_options


def _is_option(hint: Any) -> bool:
    return any(isinstance(each, OptionInfo) for each in getattr(hint, "__metadata__", ()))


def _default(field: Field[Any]) -> Any:
    return Parameter.empty if field.default is MISSING else field.default
