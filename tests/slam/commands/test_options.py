"""The fields of a record are the options of a verb."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from slam.commands.cli import app
from slam.commands.live.request import LiveRequest
from slam.commands.options import LARGEST_SEED, Json, options_of
from slam.commands.run.request import RunRequest
from slam.runtime.errors import RunError


@dataclass(frozen=True)
class Greeting:
    name: Annotated[str, typer.Option(help="whose")]
    times: Annotated[int, typer.Option("--times", "-n", min=1)] = 2
    note: str = "not on the command line"


greeter = typer.Typer(rich_markup_mode=None)


@greeter.command()
@options_of(Greeting)
def greet(greeting: Greeting, as_json: Json = False) -> None:
    """Say hello."""
    typer.echo(f"{greeting} {as_json}")


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--name", "Ada"], f"{Greeting('Ada')} False"),
        (["--name", "Ada", "-n", "3", "--json"], f"{Greeting('Ada', 3)} True"),
        (["-n", "3"], "Missing option '--name'"),
        (["--name", "Ada", "-n", "0"], "Invalid value for '--times'"),
        (["--name", "Ada", "--note", "x"], "No such option"),
        (["--help"], "Say hello."),
    ],
)
def test_a_verb_is_called_with_the_record(words: list[str], wanted: str) -> None:
    assert wanted in CliRunner().invoke(greeter, words).output


@pytest.mark.parametrize(
    ("verb", "record", "inside"), [("run", RunRequest, {"progress", "command"}), ("live", LiveRequest, {"command"})]
)
def test_every_input_is_an_option(verb: str, record: type[object], inside: set[str]) -> None:
    named = {option.name for option in typer.main.get_command(app).commands[verb].params}  # type: ignore[attr-defined]
    assert {field.name for field in fields(record)} - named == inside  # type: ignore[arg-type]


def test_a_request_names_its_recording(tmp_path: Path) -> None:
    given = RunRequest.of(dataset=str(tmp_path), camera="fov=70", frames="0:9")
    assert given.recording.tree() == {"dataset": str(tmp_path), "camera": "fov=70", "frames": "0:9"}


@pytest.mark.parametrize("seed", [-1, LARGEST_SEED + 1, "many"])
def test_a_seed_from_python_is_checked(seed: object) -> None:
    with pytest.raises(RunError, match="run_slam: seed: "):
        RunRequest.of(seed=seed)
