"""Every option of every verb meets values that make no sense: a sensible result, or one line; inputs stay as they are.

Options are found in the command lines themselves, so a new one is tested without a word here. A new verb is one row of
`VERBS`.
"""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer.main

from erfsfm.cli import app as erfsfm_app
from erfsfm.cli import main as erfsfm_main
from slam.commands.cli import app as slam_app
from slam.commands.cli import main as slam_main

HOSTILE = (
    *(
        "",
        " ",
        "nan",
        "-1",
        "0",
        "1e400",
        "9" * 30,
        "-",
        "x\ny",
        "ü[0]",
        "~/\x7f",
        "/dev/null",
        "FOLDER",
        "IMAGE",
        "TEXT",
    ),
    *("MISSING/a/b", "*", "x" * 300),
)
QUICK_RUN = ("--set", "visual_odometry.enabled=false", "--set", "mapping.enabled=false", "--set", "output.report=false")
IMAGES, RUN, WEIGHTS = "in/images", "in/run", "in/weights"


@dataclass(frozen=True)
class Verb:
    """A verb with words that work; `make test` tries some values of the ``quick`` ones."""

    program: str
    name: str
    words: tuple[str, ...]
    quick: bool = True

    @property
    def main(self) -> Callable[[], None]:
        return slam_main if self.program == "erfsfm-slam" else erfsfm_main

    def options(self) -> Iterator[str]:
        """Names of its options that take a value, as its command line has them."""
        command: Any = typer.main.get_command(slam_app if self.program == "erfsfm-slam" else erfsfm_app)
        for part in self.name.split():
            command = command.commands[part]
        for parameter in command.params:
            names = [name for name in parameter.opts if name.startswith("--")]
            if names and not parameter.is_flag:
                yield names[0]


_RUN = ("--dataset", "in/root", "--weights", WEIGHTS, "--frames", "0:4", *QUICK_RUN, "--output", "out")
VERBS = (
    Verb("erfsfm-slam", "run", _RUN),
    Verb("erfsfm-slam", "evaluate", (f"{RUN}/trajectory_network.tum.txt", f"{RUN}/reference.tum.txt")),
    Verb("erfsfm-slam", "export", (RUN, "--what", "raster", "--output", "out")),
    Verb("erfsfm-slam", "simulate", ("--route", "straight", "--frames", "2", "--width", "16", "--height", "16", "out")),
    Verb("erfsfm-slam", "plot", (RUN, "--output", "out.png")),
    Verb("erfsfm-slam", "localize", (IMAGES, "--map", RUN, "--frames", "0:1", "--output", "out.tum")),
    Verb("erfsfm-slam", "calibrate", (IMAGES, "--board", "5x4", "--output", "out.yaml"), quick=False),
    Verb("erfsfm-slam", "doctor", ("--dataset", "in/root"), quick=False),
    Verb("erfsfm-slam", "batch", ("in/root", *QUICK_RUN, "--output", "out"), quick=False),
    Verb("erfsfm-slam", "live", ("--camera", IMAGES, "--wait", "0.1", "--weights", WEIGHTS, *QUICK_RUN), quick=False),
    Verb("erfsfm", "predict", (f"{IMAGES}/000000.png", "--weights", WEIGHTS, "--output", "out")),
    Verb("erfsfm", "export", ("--weights", WEIGHTS, "--output", "out.onnx"), quick=False),
    Verb("erfsfm", "convert", ("in/text.txt", "--output", "out")),
    Verb("erfsfm", "evaluate depth", ("--dataset", "in/root", "--weights", WEIGHTS)),
    Verb("erfsfm", "evaluate pose", ("--dataset", "in/root", "--sequence", "sim", "--weights", WEIGHTS)),
    Verb("erfsfm", "networks", (), quick=False),
    Verb("erfsfm", "receptive-field", ("--network", "posenet", "--output", "out.png"), quick=False),
    Verb("erfsfm", "train", ("--config", "tiny", "--dataset", "in/root", "--set", "training.steps=1"), quick=False),
    Verb("erfsfm", "train-fusion", ("--dataset", "in/root", "--validation", "in/root", "--steps", "1"), quick=False),
    Verb("erfsfm", "pack", ("--config", "tiny", "--dataset", "in/root", "--output", "out"), quick=False),
)


@pytest.fixture(scope="module")
def inputs(kitti_root: Path, whole: Path, tiny_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of everything that the verbs read."""
    place = tmp_path_factory.mktemp("inputs") / "in"
    for source, name in ((kitti_root, "root"), (whole, "run"), (tiny_weights, "weights")):
        shutil.copytree(source, place / name)
    shutil.copytree(kitti_root / "sequences/sim/image_2", place / "images")
    shutil.copy(kitti_root / "camera.yaml", place / "images")
    (place / "text.txt").write_text("a text of words\n")
    return place


def values(verb: Verb, option: str, every: int) -> list[str]:
    """Every n-th of the values, chosen by their names."""
    return [value for value in HOSTILE if zlib.crc32(f"{verb.name} {option} {value}".encode()) % every == 0]


def hostile_words(verb: Verb, option: str, value: str, place: Path) -> list[str]:
    """The verb's words with another value of one option."""
    files = {"FOLDER": place / "root", "IMAGE": place / "images/000000.png", "TEXT": place / "text.txt"}
    words = [str(place / word.removeprefix("in/")) if word.startswith("in/") else word for word in verb.words]
    if option in words and option != "--set":
        at = words.index(option)
        del words[at : at + 2]
    return [*verb.name.split(), *words, option, str(files.get(value, value))]


def _contents(place: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(place.rglob("*")) if path.is_file()}


def hold(case: tuple[Verb, str, str], place: Path, call: Callable[..., int], capfd: pytest.CaptureFixture[str]) -> None:
    verb, option, value = case
    before = _contents(place)
    code = call(verb.main, hostile_words(verb, option, value, place))
    err = capfd.readouterr().err
    assert code in (0, 1, 2) and "Traceback" not in err and "unexpected" not in err, (case, err)
    said = [line for line in err.splitlines() if line.startswith(f"{verb.program}: ")]
    assert code != 1 or len(said) == 1, (case, err)
    assert not any(len(line) > 800 for line in said), case
    assert all(path.is_file() and path.read_bytes() == content for path, content in before.items()), case


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb.quick], ids=lambda verb: verb.name)
def test_some_values(verb: Verb, inputs: Path, call: Callable[..., int], hostile_place: None, capfd: Any) -> None:
    for option in verb.options():
        for value in values(verb, option, every=20):
            hold((verb, option, value), inputs, call, capfd)


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_all_values(verb: Verb, inputs: Path, call: Callable[..., int], hostile_place: None, capfd: Any) -> None:
    for option in verb.options():
        for value in values(verb, option, every=1 if verb.quick else 5):
            hold((verb, option, value), inputs, call, capfd)


@pytest.fixture
def hostile_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
