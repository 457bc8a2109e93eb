"""Every command and every Python block of the README and of ``docs/`` runs, on small data.

Each runs in its own copy of a small workspace that holds everything the documents name: ``KITTI``, ``my_drive.mp4``,
``results/latest``, ``runs/toy`` ... (see ``workspace``). ``SHORTER`` makes long commands short; ``NOT_RUN`` names what
cannot run here, and why. A new command runs as it stands: if it fails for want of data or time, add what it names to
the workspace or a line to one of the two tables.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import nbformat
import numpy as np
import onnx
import pytest
import torch
import typer
import yaml
from matplotlib import rc_context
from onnx import TensorProto, helper

import erfsfm.cli
import slam.commands.cli
from erfsfm.networks.presets import build
from slam.frames import Intrinsics
from slam.sequences.catalogue import open_sequence

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHELL = ("", "sh", "bash", "shell", "console")
EVO = ("evo_traj", "evo_ape", "evo_res")
PROGRAMS = ("erfsfm", "erfsfm-slam", "make", "pip", "python", *EVO)
ADVICE = "add what it names to the workspace of this test, or a line to SHORTER or NOT_RUN"

WIDTH, HEIGHT, FRAMES, FIRST_RUN, RAW_FRAMES = 208, 64, 16, 12, 9
SIZE = f"--width {WIDTH} --height {HEIGHT} --route straight"

SHORTER: tuple[tuple[str, str], ...] = (
    # (pattern, replacement), applied to the whole command line one after another
    (r"^erfsfm-slam run(?!.*(--dataset|--sequence|--frames))", r"\g<0> --frames 0:12"),
    (r"--frames 0:900\b", f"--frames 0:{FIRST_RUN}"),
    (r"^erfsfm-slam simulate .*", rf"\g<0> --width {WIDTH} --height {HEIGHT}"),
    (r"^(erfsfm-slam simulate .*)--frames \d+", r"\1--frames 12"),
    (r"^erfsfm train .*", r"\g<0> --set training.steps=2 --set training.batch=2"),
    (r"^(erfsfm train .* --prepare) prepared", r"\1 again"),  # the workspace has it, to train from
    (r"--save_results optimised.zip", "--save_results again.zip"),  # the same
    (r"--split eigen", "--split my_frames.txt"),  # the 697 frames of Eigen are not here
    (r"^erfsfm receptive-field (?!.*--images).*", rf"\g<0> --width {WIDTH} --height {HEIGHT}"),
    (r"--routes loop straight", "--routes straight"),
    (r"--routes loop", "--routes straight"),
    (r"--worlds( \d+)+", "--worlds 620"),
    (r"^(python tools/benchmark.py .*)--frames \d+", r"\1--frames 32"),
    (r"^(python tools/benchmark.py maps .*)--parts( '[^']+')+", r"\1--parts"),
)

FAST = ("README.md",)  # what a new user reads first; the commands of other pages are slow
SLOW = (
    r"^erfsfm-slam run(?! --dataset my_drive.mp4 --camera)",  # a whole run each; test_every_command_is_understood
    r"^erfsfm export ",  # tests/erfsfm/test_export.py exports smaller networks
    r"^python tools/",  # several whole runs each
    r"^erfsfm receptive-field --(output|weights default)",  # docs/design/networks.md has it with smaller weights
    r"^erfsfm train --config table1",  # networks of the paper's size
)

NOT_RUN: tuple[tuple[str, str], ...] = (
    (r"^make ", "it sets up, lints or starts these very tests"),
    (
        r"--config default-gpu ",
        "it wants hours of labels, and a GPU; tests/erfsfm/data/test_prepared.py has small data",
    ),
    (r"^erfsfm-slam download ", "it downloads; tests/slam/commands/downloads has a server"),
    (
        r"^erfsfm-slam calibrate ",
        "it wants images of a board; tests/slam/commands/test_calibration.py renders them",
    ),
    (
        r"--truth many-views",
        "it wants a drive; tests/erfsfm/evaluation/test_depth_protocols.py has a short one",
    ),
    (r"mapping.voxel_size_m=0.1|make_figures.py ", "it wants frame 80 of KITTI's drive 0013"),
    (r"tools/reproduce.py ", "it trains the paper's networks"),
    (
        r"benchmark.py full-size ",
        "it wants images at the size of KITTI's cameras, and half an hour",
    ),
    (r"benchmark.py handheld ", "it wants data sets, or minutes a room"),
    (
        r"benchmark.py speed ",
        "it wants another checkout; tests/tools/test_benchmark.py has the parts",
    ),
    (
        r"train-fusion|runs/fusion|--seed 1[01]00",
        "it wants worlds; tests/erfsfm/training/test_fusion.py has small ones",
    ),
    (
        r"^erfsfm-slam live ",
        "it wants a camera; tests/slam/commands/test_live.py has folders and videos that go on",
    ),
    (r"^erfsfm-slam batch ", "it starts a cluster; tests/slam/commands/batch does"),
    (
        r"--dataset walk ",
        "it wants a walk of 311 frames; tests/slam/pipeline/test_run.py has known distances",
    ),
    (
        r"clear640|other640|kitti05",
        "several drives of 300 frames; tests/slam/commands/localisation has short ones",
    ),
    (r"--config own |runs/own", "it wants a drive; tests/integration/test_own_training.py has one"),
)


@dataclass(frozen=True)
class Block:
    """A command, or the text of a fenced block, and where it stands."""

    document: Path
    line: int
    text: str
    language: str = ""

    def __str__(self) -> str:
        return f"{self.document.relative_to(ROOT)}:{self.line}"


def fenced(document: Path) -> Iterator[Block]:
    """Blocks between lines of three backticks."""
    opened: tuple[int, str] | None = None
    held: list[str] = []
    for number, line in enumerate(document.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.startswith("```"):
            held.append(line)
        elif opened is None:
            opened, held = (number + 1, line[3:].strip()), []
        else:
            yield Block(document, opened[0], "\n".join(held), opened[1])
            opened = None


def command_lines(block: Block) -> Iterator[Block]:
    """The commands of a block of shell lines, without comments and prompts, continued lines joined."""
    text = block.text.replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), start=block.line):
        words = shlex.split(line.removeprefix("$ "), comments=True)
        if words:
            yield Block(block.document, number, shlex.join(words))


def indented(document: Path) -> Iterator[Block]:
    """Lines indented by four blanks, outside of fences, that start with one of our programs."""
    text = document.read_text(encoding="utf-8")
    text = re.sub(
        r"^```.*?^```",
        lambda found: "\n" * found[0].count("\n"),
        text,
        flags=re.DOTALL | re.MULTILINE,
    )
    programs = "|".join(map(re.escape, PROGRAMS))
    pattern = rf"^    ((?:[A-Z_]+=\S+ )*(?:{programs}) (?:.*\\\n)*.*)$"
    for found in re.finditer(pattern, text, flags=re.MULTILINE):
        yield Block(document, text.count("\n", 0, found.start()) + 1, found[1])


def commands() -> list[Block]:
    found: list[Block] = []
    for document in DOCUMENTS:
        for block in [b for b in fenced(document) if b.language in SHELL] + list(
            indented(document)
        ):
            found += command_lines(block)
    return found


def bare(command: str) -> str:
    """A command without leading assignments of environment variables."""
    return re.sub(r"^(?:[A-Z_]+=\S+ )+", "", command)


def reason_not_to_run(command: str) -> str:
    return next((reason for pattern, reason in NOT_RUN if re.search(pattern, bare(command))), "")


def shorter(command: str) -> str:
    for pattern, replacement in SHORTER:
        command = re.sub(pattern, replacement, command)
    return command


def parameter(block: Block) -> Any:
    is_slow = block.document.name not in FAST or any(
        re.search(pattern, block.text) for pattern in SLOW
    )
    return pytest.param(
        block,
        id=f"{block} {block.text.splitlines()[0][:50]}",
        marks=[pytest.mark.slow] if is_slow else [],
    )


# a command that several pages have runs once, where it stands first
RUNNABLE = [
    *{
        block.text: block for block in reversed(commands()) if not reason_not_to_run(block.text)
    }.values()
][::-1]


MAINS: dict[str, Any] = {"erfsfm": erfsfm.cli.main, "erfsfm-slam": slam.commands.cli.main}


def call(command: str) -> None:
    """Run a command line in the current folder; all but tools in this process, for the time it saves."""
    program, *arguments = shlex.split(command)
    if program == "python":
        words = [sys.executable, str(ROOT / arguments.pop(0)), *arguments]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        finished = subprocess.run(
            words, env=environment, capture_output=True, text=True, check=False
        )
        assert finished.returncode == 0, finished.stdout + finished.stderr
        return
    with (
        pytest.MonkeyPatch.context() as patch,
        rc_context(),
    ):  # evo changes the settings of Matplotlib
        main = MAINS.get(program) or entry_points(group="console_scripts")[program].load()
        patch.setattr(sys, "argv", [program, *arguments])
        try:
            main()
        except SystemExit as end:
            assert not end.code, f"exit code {end.code}"


def old_checkpoint(path: Path, preset: str) -> None:
    """A small network under the names of SfMLearner-PyTorch."""
    renamed = {}
    for name, value in build(preset, "paper", 0.25, 4).state_dict().items():
        name = re.sub(
            r"encoder\.stages\.(\d)\.(\d)\.0",
            lambda m: f"conv{int(m[1]) + 1}.{2 * int(m[2])}",
            name,
        )
        name = re.sub(r"(upconv|iconv)s\.(\d)", lambda m: f"{m[1]}{7 - int(m[2])}", name)
        name = re.sub(r"^heads\.(\d)", lambda m: f"predict_disp{4 - int(m[1])}.0", name)
        renamed[name.replace("pose_head", "pose_pred")] = value
    torch.save({"state_dict": renamed}, path)


def relative_network(path: Path) -> None:
    """A network of any input size whose disparity is an image's mean brightness, shifted to be positive."""
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Add", ["mean", "shift"], ["depth"]),
    ]
    image, depth = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
        for name, shape in (("image", [1, 3, "height", "width"]), ("depth", None))
    )
    graph = helper.make_graph(
        nodes,
        "relative",
        [image],
        [depth],
        [helper.make_tensor("shift", TensorProto.FLOAT, [1], [3.0])],
    )
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path
    )


def raw_drive(root: Path, sequence: Path) -> None:
    """A KITTI raw drive of the images and scans of a simulated sequence, at 10 m/s."""
    date = root / "2011_09_26"
    drive = date / "2011_09_26_drive_0013_sync"
    calibration = dict(
        line.split(":", 1) for line in (sequence / "calib.txt").read_text().splitlines()
    )
    T_camera_lidar = np.array(calibration["Tr"].split(), float).reshape(3, 4)
    for kind, source, suffix in (
        ("image_02", "image_2", "png"),
        ("velodyne_points", "velodyne", "bin"),
    ):
        (drive / kind / "data").mkdir(parents=True)
        for file in sorted((sequence / source).glob(f"*.{suffix}")):
            shutil.copy(file, drive / kind / "data" / f"{int(file.stem):010d}.{suffix}")
    (drive / "oxts" / "data").mkdir(parents=True)
    stamps = [f"2011-09-26 13:10:51.{100_000_000 * k:09d}\n" for k in range(RAW_FRAMES)]
    (drive / "oxts" / "timestamps.txt").write_text("".join(stamps))
    for k in range(RAW_FRAMES):
        values = np.zeros(30)
        values[[6, 7]] = 6.0, 8.0
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, values)))
    (date / "calib_cam_to_cam.txt").write_text(
        f"R_rect_00: 1 0 0 0 1 0 0 0 1\nS_rect_02: {WIDTH} {HEIGHT}\nP_rect_02:{calibration['P2']}\n"
    )
    R, t = (
        " ".join(map(str, part.ravel())) for part in (T_camera_lidar[:, :3], T_camera_lidar[:, 3])
    )
    (date / "calib_velo_to_cam.txt").write_text(f"R: {R}\nT: {t}\n")


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that the first pages name, small. Not to be changed: each command works on a copy."""
    here = tmp_path_factory.mktemp("workspace") / "here"
    here.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        call(f"erfsfm-slam simulate world {SIZE} --frames {FRAMES} --seed 700 --depth")
        for name in ("KITTI", "KITTI_ODOMETRY", "path/to/kitti"):
            for sequence in ("05", "06", "09"):
                shutil.copytree("world/sequences/sim", f"{name}/sequences/{sequence}")
                Path(name, "poses").mkdir(exist_ok=True)
                shutil.copy("world/poses/sim.txt", f"{name}/poses/{sequence}.txt")
        call(f"erfsfm-slam run --dataset KITTI --sequence 09 --frames 0:{FIRST_RUN}")
        Path("poses").mkdir()
        rows = Path("KITTI/poses/09.txt").read_text().splitlines(keepends=True)
        Path("poses/09.txt").write_text("".join(rows[:FIRST_RUN]))
        images = sorted(Path("world/sequences/sim/image_2").glob("*.png"))
        for name in ("photos", "images", "drive/images"):
            Path(name).mkdir(parents=True)
            for image in images[:5]:
                shutil.copy(image, name)
        shutil.copy("world/camera.yaml", "camera.yaml")
        video = cv2.VideoWriter(
            "my_drive.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (WIDTH, HEIGHT)
        )
        for image in images:
            video.write(cv2.imread(str(image)))
        video.release()
    return here


@pytest.fixture(scope="module")
def whole_workspace(workspace: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that the documents name."""
    here = tmp_path_factory.mktemp("whole") / "here"
    copy_of(workspace, here)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        call(f"erfsfm-slam simulate scanned {SIZE} --frames {RAW_FRAMES} --seed 701 --lidar")
        call(f"erfsfm-slam simulate held_out {SIZE} --frames 30 --seed 501")
        train = "erfsfm train --config tiny --dataset world --set training.steps=2 --output"
        call(f"{train} runs/toy")
        call("erfsfm train --config tiny --dataset world --prepare prepared")
        call(f"{train} runs/table1-dfc --set network.sources=4")
        call("erfsfm predict world/sequences/sim/image_2 --weights runs/toy --output depth")
        call("erfsfm export --weights runs/toy --format onnx --output net.onnx")
        relative_network(Path("relative.onnx"))
        copy_of(Path("world"), Path("worlds/600"))
        raw_drive(Path("KITTI_RAW"), Path("scanned/sequences/sim"))
        Path("my_frames.txt").write_text("2011_09_26_drive_0013 5\n")
        for name, archive in (("network", "chained"), ("optimised", "optimised")):
            files = f"results/latest/reference.kitti.txt results/latest/trajectory_{name}.kitti.txt"
            call(f"evo_ape kitti {files} -as --save_results {archive}.zip")
        for name in ("dfvo.txt", "runs/orb_0.txt", "runs/orb_1.txt"):  # of other systems
            shutil.copy("results/latest/trajectory_network.kitti.txt", name)
        fixes = [f"{k / 10},{49 + k * 1e-5},8.4,114" for k in range(FRAMES)]
        Path("track.csv").write_text("\n".join(["stamp,latitude,longitude,altitude", *fixes]))
        for file in ("old", "exp_pose_model_best"):
            old_checkpoint(Path(f"{file}.pth.tar"), "posenet")
        old_checkpoint(Path("dispnet_model_best.pth.tar"), "depthnet")
        Path("weights").mkdir()
        call(
            "erfsfm convert dispnet_model_best.pth.tar exp_pose_model_best.pth.tar --output weights/old"
        )
        Path("docs").mkdir()
    return here


def copy_of(folder: Path, copy: Path) -> None:
    """Of a folder, by links: the system never writes into a file."""
    shutil.copytree(folder, copy, symlinks=True, copy_function=os.link)


@pytest.fixture
def at_work(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A copy of the workspace as the current folder, where ``$KITTI_ODOMETRY`` is its ``KITTI``."""
    here = tmp_path / "here"
    is_slow = request.node.get_closest_marker("slow") is not None
    copy_of(request.getfixturevalue("whole_workspace" if is_slow else "workspace"), here)
    monkeypatch.chdir(here)
    monkeypatch.setenv("KITTI_ODOMETRY", str(here / "KITTI"))
    return here


def remove_outputs(command: str) -> None:
    """Take away what the command is going to write: the workspace holds it for the commands that read it."""
    words = shlex.split(command)
    written = [words[2]] if words[1] == "simulate" else []
    written += [value for option, value in pairwise(words) if option == "--output"]
    for name in map(Path, written):
        if name.is_dir():
            shutil.rmtree(name)


@pytest.mark.parametrize("block", [parameter(block) for block in RUNNABLE])
def test_every_command_runs(block: Block, at_work: Path):
    command = shorter(block.text)
    if shlex.split(command)[0] not in PROGRAMS:
        pytest.fail(f"{block}: '{block.text}' starts no program that this test knows; {ADVICE}")
    remove_outputs(command)
    try:
        call(command)
    except BaseException as error:
        error.add_note(f"{block}: '{block.text}', run as '{command}', failed; {ADVICE}")
        raise


UsageError = typer.BadParameter.__bases__[0]  # typer has its own click


def understood(reader: Any, words: list[str]) -> None:
    """Read the words of a command line as its program does, and do nothing."""
    name = ""
    while hasattr(reader, "commands"):
        name, *words = words
        reader = reader.commands[name]
    reader.make_context(name, words)


def test_every_command_is_understood():
    """Also where it is not run or is slow: its options exist, and their values are of the right kind."""
    readers: dict[str, Any] = {
        name: typer.main.get_command(app)
        for name, app in (("erfsfm", erfsfm.cli.app), ("erfsfm-slam", slam.commands.cli.app))
    }
    for block in commands():
        program, *words = shlex.split(bare(block.text))
        if program in readers:
            try:
                understood(readers[program], words)
            except UsageError as error:
                raise AssertionError(f"{block}: {error.format_message()}") from error
    with pytest.raises(UsageError):
        understood(readers["erfsfm"], ["networks", "--no-such-option"])


def stand_ins(world: Path) -> dict[str, Any]:
    """Variables that the Python blocks expect: a calibrated camera and some images."""
    camera = yaml.safe_load((world / "camera.yaml").read_text())
    files = sorted((world / "sequences/sim/image_2").glob("*.png"))
    images = [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in files]
    size = {name: camera[name] for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {
        "intrinsics": Intrinsics(**size),
        "camera": [(0.1 * k, image) for k, image in enumerate(images)],
        "image": images[0],
        "five_images": images[:5],
    }


def cells_of_notebook() -> list[Any]:
    """The cells of the one notebook; its code is compiled under the name of its file."""
    path = ROOT / "docs" / "first-steps.ipynb"
    notebook = json.loads(path.read_text(encoding="utf-8"))
    nbformat.validate(notebook)
    sources = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook["cells"])
    return [
        compile(source, f"{path.name}, code cell {k}", "exec")
        for k, source in enumerate(sources, 1)
    ]


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, Any] = {}
    for cell in cells_of_notebook():
        exec(cell, names)
    assert names["errors"].ate_rmse_m < 0.8, "0.4 m were measured"
    assert np.isfinite(names["sigmas"]).all() and names["depth_m"].min() > 0
    written = {
        path.relative_to("first-steps").as_posix() for path in Path("first-steps").rglob("*")
    }
    assert {
        "map.ply",
        "model/points3D.txt",
        "model/images/000119.png",
        "run/report.html",
    } <= written


def blocks(*languages: str) -> list[Block]:
    return [
        block for document in DOCUMENTS for block in fenced(document) if block.language in languages
    ]


@pytest.mark.parametrize("block", [parameter(block) for block in blocks("python", "py")])
def test_every_python_block_runs(block: Block, at_work: Path):
    names = stand_ins(at_work / "world")
    code = compile(
        "\n" * (block.line - 1) + block.text, str(block.document), "exec"
    )  # a traceback names the line
    try:
        exec(code, names)
    except Exception as error:
        error.add_note(f"{block}: a name that the reader is to have belongs into stand_ins")
        raise


@pytest.mark.parametrize("block", blocks("yaml", "yml"), ids=str)
def test_every_camera_file_opens(block: Block, tmp_path: Path):
    camera = yaml.safe_load(block.text)
    assert "fx" in camera, f"{block}: this test reads camera.yaml only; add this kind of YAML"
    for k in range(6):
        cv2.imwrite(
            str(tmp_path / f"{k}.png"),
            np.full((camera["height"], camera["width"], 3), 90 + k, np.uint8),
        )
    (tmp_path / "camera.yaml").write_text(block.text)
    assert len(open_sequence(tmp_path)) == 6
