"""A whole training on a toy drive: output folder, resume, errors."""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from erfsfm.checkpoint import Model, build_networks, load_model, save_model
from erfsfm.common.errors import BusyError, ConfigError, DataError, TrainingError
from erfsfm.common.files import FolderLock
from erfsfm.common.signals import Terminated
from erfsfm.config import ExperimentConfig, TrainedNetworks, dump_yaml, load_experiment
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import DepthInput, ModelRecord
from erfsfm.networks.depth_net import DepthNet
from erfsfm.training.module import SelfSupervision, learning_rate_factor
from erfsfm.training.output_folder import licence_of
from erfsfm.training.run import train

Small = dict[str, dict[str, object]]
Configure = Callable[..., ExperimentConfig]


@pytest.fixture(autouse=True)
def _one_thread() -> Any:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drives")


@pytest.fixture
def world(drives: Path, write_root: Callable[..., Path]) -> Path:
    """A drive of 10 frames with depth and poses."""
    return (
        drives / "world"
        if (drives / "world").exists()
        else write_root(drives / "world", frames=10, depth=True)
    )


@pytest.fixture
def held_out(drives: Path, write_root: Callable[..., Path]) -> Path:
    """A simulated drive with a seed that validates."""
    root = drives / "held_out"
    return root if root.exists() else write_root(root, frames=8, depth=True, seed=500)


def configure(small: Small, roots: list[Path], **sections: dict[str, Any]) -> ExperimentConfig:
    data = {"roots": roots, "validation": ["simulated/500-599"]}
    tree = {
        name: small.get(name, {}) | ({"data": data}.get(name, {})) | sections.get(name, {})
        for name in {*small, *sections}
    }
    return ExperimentConfig.model_validate(tree)


@pytest.fixture
def alone(small: Small, world: Path) -> Configure:
    """Of a training on the drive of 10 frames, without a validation."""
    return partial(configure, small, [world])


@pytest.fixture
def both(small: Small, world: Path, held_out: Path) -> Configure:
    """The same with a validation."""
    return partial(configure, small, [world, held_out])


def weights_of(folder: Path) -> list[Tensor]:
    model = load_model(folder)
    return [
        *model.networks["depth"].state_dict().values(),
        *model.networks["pose"].state_dict().values(),
    ]


def same(first: Path, second: Path) -> bool:
    return all(
        torch.equal(a, b) for a, b in zip(weights_of(first), weights_of(second), strict=True)
    )


class Interrupt(Exception):
    """A power cut."""


def interrupted(
    monkeypatch: pytest.MonkeyPatch, config: ExperimentConfig, output: Path, step: int
) -> None:
    """The process dies in the midst of the step after ``step`` steps."""
    original = SelfSupervision.training_step

    def dying(self: SelfSupervision, batch: dict[str, Tensor], index: int) -> Tensor:
        if self.global_step == step:
            raise Interrupt
        return original(self, batch, index)

    with monkeypatch.context() as patched, pytest.raises(Interrupt):
        patched.setattr(SelfSupervision, "training_step", dying)
        train(config, output, device="cpu")


def test_the_folder_can_be_used(both, tmp_path):
    config = both()
    output = train(config, tmp_path / "run", device="cpu", command="erfsfm train")
    assert output == tmp_path / "run"
    predictor = DepthPosePredictor.from_weights(output)
    record = predictor.record
    assert record.trained_on == ["kitti_odometry/00[0:10]"], "not what only validates"
    assert record.licence.startswith("CC BY-NC-SA")
    assert record.command == "erfsfm train"
    assert record.network == config.network
    wanted = {"photometric", "abs_rel", "depth_scale", "depth_scale_spread", "disparity_spread"}
    assert wanted <= record.metrics.keys()
    assert all(np.isfinite(value) for value in record.metrics.values())
    assert predictor.depth(np.zeros((50, 80, 3), np.uint8)).shape == (50, 80)
    assert load_model(output / "last").record.step == 4
    assert load_experiment(output / "config.yaml") == config
    with (output / "logs" / "csv" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    steps = [int(row["step"]) for row in rows if row["loss"]]
    assert steps == [3], "a short training is logged at its end"
    assert any(row["validation/abs_rel"] for row in rows)


def test_two_runs_are_equal(alone, tmp_path):
    config = alone(training={"steps": 2})
    for name in ("a", "b"):
        train(config, tmp_path / name, device="cpu")
    assert same(tmp_path / "a", tmp_path / "b")
    other = alone(training={"steps": 2, "seed": 1})
    train(other, tmp_path / "c", device="cpu")
    assert not same(tmp_path / "a", tmp_path / "c")


@pytest.mark.slow
@pytest.mark.parametrize(
    "schedule, normalisation, average_decay", [("constant", "none", 0), ("cosine", "batch", 0.8)]
)
def test_resume_ends_with_identical_weights(
    both, small, tmp_path, monkeypatch, schedule, normalisation, average_decay
):
    """Interrupted at step 5 of 6; the last checkpoint is of step 4, where there also was a validation."""
    small["network"]["normalisation"] = normalisation
    training = {"steps": 6, "schedule": schedule, "learning_rate": 1e-3, "gradient_clip": 1.0}
    training |= {"average_decay": average_decay}
    config = both(training=training)
    train(config, tmp_path / "whole", device="cpu")
    interrupted(monkeypatch, config, tmp_path / "cut", 5)
    steps: list[int] = []
    original = SelfSupervision.training_step

    def watching(self: SelfSupervision, batch: dict[str, Tensor], index: int) -> Tensor:
        steps.append(self.global_step)
        return original(self, batch, index)

    monkeypatch.setattr(SelfSupervision, "training_step", watching)
    train(config, tmp_path / "cut", resume=True, device="cpu")
    assert steps == [4, 5]
    assert same(tmp_path / "whole" / "last", tmp_path / "cut" / "last")
    assert same(tmp_path / "whole", tmp_path / "cut"), "the best as well"
    records = [load_model(tmp_path / name / "last").record for name in ("whole", "cut")]
    assert records[0].metrics == records[1].metrics
    assert records[0].step == records[1].step == 6
    assert (tmp_path / "cut" / "logs" / "csv" / "metrics.csv").is_file(), (
        "the log before the interruption stays"
    )
    assert (tmp_path / "cut" / "logs" / "csv_from_4" / "metrics.csv").is_file()


@pytest.mark.slow
def test_the_average_of_the_weights_is_what_is_measured_and_written(both, tmp_path, monkeypatch):
    def steps_of(name: str, **training: Any) -> Path:
        return train(both(training=training), tmp_path / name, device="cpu") / "last"

    first, second, third = (
        weights_of(steps_of(str(steps), steps=steps, validate_every=9)) for steps in (1, 2, 3)
    )
    expected = [a / 4 + b / 4 + c / 2 for a, b, c in zip(first, second, third, strict=True)]
    averaged = steps_of("averaged", steps=3, average_decay=0.5, validate_every=1)
    torch.testing.assert_close(weights_of(averaged), expected)
    still = both(training={"steps": 1, "learning_rate": 1e-12}).model_copy(
        update={"initial_weights": str(averaged)}
    )
    again = load_model(train(still, tmp_path / "still", device="cpu")).record.metrics
    assert load_model(averaged).record.metrics == pytest.approx(again, rel=1e-4)
    config = both(training={"steps": 5, "validate_every": 4, "average_decay": 0.5})
    interrupted(monkeypatch, config, tmp_path / "cut", 3)
    torch.testing.assert_close(weights_of(tmp_path / "cut" / "last"), expected)


def test_a_folder_that_another_training_writes_to_is_refused(alone, tmp_path):
    with FolderLock() as lock:
        lock.take(tmp_path / "run")
        with pytest.raises(BusyError, match="run"):
            train(alone(), tmp_path / "run", device="cpu")
    assert not list((tmp_path / "run").iterdir())


def scripted_validation(monkeypatch: pytest.MonkeyPatch, name: str, values: list[float]) -> None:
    """Let the k-th validation of the run, counted by its steps, measure the k-th value."""
    original = SelfSupervision.measured

    def measured(self: SelfSupervision) -> dict[str, float]:
        return original(self) | {name: values[self.global_step - 1]}

    monkeypatch.setattr(SelfSupervision, "measured", measured)


def poses_measured(world: Path, folder: Path) -> dict[str, Any]:
    """Settings of a teacher that has measured the poses of the drive of 10 frames."""
    (recording,) = discover(world)
    ManyViewTeacher(folder / "measured", (32, 64), 2).drive(recording).keep_poses(
        np.stack([np.eye(4)] * 10)
    )
    return {"views": "many", "rotation_weight": 1.0, "cache": folder / "measured"}


def saved(config: ExperimentConfig, networks: TrainedNetworks, folder: Path) -> Path:
    """Weights of the experiment's networks, or of one of them."""
    record = ModelRecord(network=config.network, networks=networks, trained_on=[])
    every = build_networks(config.network)
    save_model(folder, Model(record, {kind: every[kind] for kind in record.kinds}))
    return folder


@pytest.mark.parametrize(
    ("networks", "steps"),
    [
        ("both", {".": 2, "best_pose": 3, "last": 4}),
        pytest.param("pose", {".": 3, "best_pose": 3, "last": 4}, marks=pytest.mark.slow),
        pytest.param("depth", {".": 2, "last": 4}, marks=pytest.mark.slow),
    ],
)
def test_best_depth_and_best_pose_are_kept_apart(
    both, world, tmp_path, monkeypatch, networks, steps
):
    scripted_validation(
        monkeypatch, "abs_rel", [0.3, 0.2, 0.5, 0.4] if networks != "pose" else [0.3] * 4
    )
    scripted_validation(monkeypatch, "snippet_ate", [0.05, math.nan, 0.01, 0.02])
    teacher = poses_measured(world, tmp_path) if networks == "pose" else {}
    training = {"validate_every": 1, "networks": networks}
    config = both(training=training, teacher=teacher)
    if networks == "depth":
        config = config.model_copy(
            update={"initial_weights": str(saved(config, "both", tmp_path / "initial"))}
        )
    output = train(config, tmp_path / "run", device="cpu")
    written = [
        name for name in (".", "best_pose", "last") if (output / name / "model.yaml").exists()
    ]
    assert {name: load_model(output / name).record.step for name in written} == steps


class Clock:
    """Time that passes by one second a step."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        original = SelfSupervision.training_step

        def timed(module: SelfSupervision, batch: dict[str, Tensor], index: int) -> Tensor:
            self.now += 1
            return original(module, batch, index)

        monkeypatch.setattr(SelfSupervision, "training_step", timed)
        monkeypatch.setattr(
            "lightning.pytorch.callbacks.timer.time", SimpleNamespace(monotonic=lambda: self.now)
        )


@pytest.mark.slow
def test_a_time_limit_ends_a_run_with_its_schedule_also_after_a_resume(
    small, world, held_out, tmp_path, monkeypatch
):
    """Three seconds, at a second a step, are three steps, whatever the number of steps allowed."""
    roots = [world, held_out]
    three = configure(
        small, roots, training={"steps": 3, "schedule": "cosine", "validate_every": 100}
    )
    timed = configure(
        small, roots, training={**three.training.model_dump(), "steps": 1000, "minutes": 0.05}
    )
    train(three, tmp_path / "three", device="cpu")
    Clock(monkeypatch)
    told: list[tuple[int, int]] = []
    train(
        timed,
        tmp_path / "timed",
        device="cpu",
        progress=lambda stage, done, total: told.append((done, total)),
    )
    assert told == [(1, 3), (2, 3), (3, 3)], "of the steps that there is time for"
    record = load_model(tmp_path / "timed" / "last").record
    assert record.step == 3 and "abs_rel" in record.metrics, "the end is validated"
    assert same(tmp_path / "timed" / "last", tmp_path / "three" / "last")
    interrupted(monkeypatch, timed, tmp_path / "cut", step=2)
    train(timed, tmp_path / "cut", resume=True, device="cpu")
    assert same(tmp_path / "cut" / "last", tmp_path / "three" / "last")
    train(timed, tmp_path / "cut", resume=True, device="cpu")
    assert load_model(tmp_path / "cut" / "last").record.step == 3, "no time is left"


@pytest.mark.parametrize(
    ("schedule", "factors"), [("constant", (1, 1, 1, 1)), ("cosine", (1, 0.51, 0.163518, 0.02))]
)
def test_learning_rate_factor(schedule, factors):
    for progress, factor in zip((0, 0.5, 0.75, 1), factors):
        assert learning_rate_factor(schedule, progress) == pytest.approx(factor, abs=1e-5)


def test_a_cosine_begins_with_a_warm_up():
    rates = [learning_rate_factor("cosine", 0.0, step) for step in (0, 149, 299, 5000)]
    assert rates == pytest.approx([1 / 300, 0.5, 1, 1])
    assert learning_rate_factor("cosine", 0.05, 3) > 0.99, "a short run has a short one"
    assert learning_rate_factor("constant", 0.0, 0) == 1, "the paper's schedule"


def test_initial_weights_pass_on_their_leak_record_and_the_size_of_single_images(
    alone, small, held_out, tmp_path, monkeypatch
):
    first = train(alone(training={"steps": 1}), tmp_path / "first", device="cpu")
    larger, model = DepthInput(height=64, width=208, disparity=0.8), load_model(first)
    save_model(
        first, replace(model, record=model.record.model_copy(update={"depth_input": larger}))
    )
    config = configure(small, [held_out], data={"validation": []}).model_copy(
        update={"initial_weights": str(first)}
    )
    gentle = config.training.model_copy(update={"learning_rate": 1e-12})
    config = config.model_copy(update={"training": gentle})
    interrupted(monkeypatch, config, tmp_path / "second", 3)
    second = train(config, tmp_path / "second", resume=True, device="cpu")
    record = load_model(second).record
    assert record.trained_on == ["simulated/500", "kitti_odometry/00[0:10]"], "also after a resume"
    assert record.licence.startswith("CC BY-NC-SA") and record.depth_input == larger
    for trained, initial in zip(weights_of(second), weights_of(first), strict=True):
        torch.testing.assert_close(trained, initial)


def test_resume_with_other_data_keeps_the_leak_record(
    alone, small, held_out, tmp_path, monkeypatch
):
    interrupted(monkeypatch, alone(), tmp_path / "run", 3)
    other = configure(small, [held_out], data={"validation": []})
    train(other, tmp_path / "run", resume=True, device="cpu")
    assert load_model(tmp_path / "run").record.trained_on == [
        "simulated/500",
        "kitti_odometry/00[0:10]",
    ]


def test_a_non_finite_loss_stops_the_run(alone, tmp_path, monkeypatch):
    original = SelfSupervision.training_step

    def poisoned(self: SelfSupervision, batch: dict[str, Tensor], index: int) -> Tensor:
        if self.global_step == 3:
            batch["target"][0, 0, 0, 0] = torch.nan
        return original(self, batch, index)

    monkeypatch.setattr(SelfSupervision, "training_step", poisoned)
    with pytest.raises(TrainingError, match=r"step 3.*photometric nan"):
        train(alone(), tmp_path / "run", device="cpu")
    assert load_model(tmp_path / "run" / "last").record.step == 3, "the weights so far"
    assert all(torch.isfinite(tensor).all() for tensor in weights_of(tmp_path / "run" / "last"))
    monkeypatch.undo()
    train(alone(), tmp_path / "run", resume=True, device="cpu")


def test_a_training_that_ends_in_constant_depth_says_so(alone, tmp_path, monkeypatch):
    """Far shorter than the hundred steps after which one is stopped."""
    original = DepthNet.forward

    def constant(disparities: list[Tensor] | Tensor) -> list[Tensor] | Tensor:
        if isinstance(disparities, Tensor):
            return 0.0 * disparities + 0.1
        return [0.0 * each + 0.1 for each in disparities]

    monkeypatch.setattr(DepthNet, "forward", lambda net, image: constant(original(net, image)))
    with pytest.raises(TrainingError, match=r"one constant for 4 steps at step 4.*in last/"):
        train(alone(), tmp_path / "run", device="cpu")
    assert load_model(tmp_path / "run" / "last").record.step == 4


def test_small_shared_memory_is_said_and_does_not_stop_a_training(
    alone, tmp_path, monkeypatch, caplog
):
    """Data loaders that hand over batches by it would end, and the training wait for them for ever."""
    free = SimpleNamespace(free=50_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free)
    train(alone(data={"workers": 2}, training={"steps": 1}), tmp_path / "run", device="cpu")
    assert "2 data loaders want 0.4" in caplog.text and "--shm-size" in caplog.text


@pytest.mark.usefixtures("as_in_the_foreground")
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_ends_a_training_in_order(alone, tmp_path, monkeypatch, name, code):
    original = SelfSupervision.training_step

    def signalled(self: SelfSupervision, batch: dict[str, Tensor], index: int) -> Tensor:
        if self.global_step == 1:
            os.kill(os.getpid(), getattr(signal, name))
        return original(self, batch, index)

    monkeypatch.setattr(SelfSupervision, "training_step", signalled)
    config = alone(training={"checkpoint_every": 1 if name == "SIGHUP" else 2})
    with pytest.raises(
        Terminated, match=f"{name} at step 1.*{'--resume' if name == 'SIGHUP' else 'start again'}"
    ) as ended:
        train(config, tmp_path / "run", device="cpu")
    assert ended.value.code == code and ("--resume" in str(ended.value)) == (name == "SIGHUP")
    assert load_model(tmp_path / "run" / "last").record.step == 1


@pytest.mark.slow
def test_a_loader_that_is_killed_is_said_in_one_line(alone, tmp_path, monkeypatch):
    original = SelfSupervision.training_step

    def killing(self: SelfSupervision, batch: dict[str, Tensor], index: int) -> Tensor:
        for child in multiprocessing.active_children():
            child.kill()
            child.join()
        return original(self, batch, index)

    monkeypatch.setattr(SelfSupervision, "training_step", killing)
    with pytest.raises(TrainingError, match=r"loader was killed, for want of memory"):
        train(alone(data={"workers": 1}), tmp_path / "run", device="cpu")


# refusals


@pytest.fixture
def cut(
    alone: Configure, drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[ExperimentConfig, Path]:
    """A copy of an interrupted run, and its configuration."""
    config = alone()
    if not (drives / "cut").exists():
        interrupted(monkeypatch, config, drives / "cut", 3)
    return config, Path(shutil.copytree(drives / "cut", tmp_path / "run"))


def test_weights_are_not_overwritten(alone, tmp_path):
    """A short run leaves no checkpoint, but it leaves weights."""
    config = alone(training={"steps": 1})
    train(config, tmp_path / "run", device="cpu")
    assert not (tmp_path / "run" / "checkpoints").exists()
    with pytest.raises(TrainingError, match="--output"):
        train(config, tmp_path / "run", device="cpu")


def test_resume_with_other_networks(cut):
    config, output = cut
    network = config.network.model_copy(update={"pose": "erf-posenet-dilated"})
    with pytest.raises(ConfigError, match="networks"):
        train(config.model_copy(update={"network": network}), output, resume=True, device="cpu")


@pytest.mark.parametrize("text", ["", "[1]", "network: {}", "network: {}\ntraining: 1"])
def test_resume_with_a_damaged_configuration(cut, text):
    config, output = cut
    (output / "config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"config\.yaml"):
        train(config, output, resume=True, device="cpu")


class Malicious:
    """An object that runs a command when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (f"touch {self.mark}",)


def refused_checkpoint(cut: tuple[ExperimentConfig, Path]) -> None:
    config, output = cut
    with pytest.raises(TrainingError):
        train(config, output, resume=True, device="cpu")


@pytest.mark.parametrize("kind", ["torch", "pickle"])
def test_code_in_a_checkpoint_never_runs(cut, tmp_path, kind):
    path = cut[1] / "checkpoints" / "last.ckpt"
    state = torch.load(path, weights_only=True) | {"extra": Malicious(tmp_path / "executed")}
    if kind == "torch":
        torch.save(state, path)
    else:
        path.write_bytes(pickle.dumps(state, protocol=2))
    refused_checkpoint(cut)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("workers", [0, 1])
def test_a_broken_image_is_one_line(small, tmp_path, write_root, workers):
    root = write_root(tmp_path / "root", frames=4)
    for index in (1, 2):
        (root / f"sequences/00/image_2/{index:06d}.png").write_bytes(b"broken")
    with pytest.raises(DataError, match=r"00000[12]\.png cannot be decoded") as caught:
        train(configure(small, [root], data={"workers": 1}), tmp_path / "run", device="cpu")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("seen", "licence"),
    [
        (["simulated/0-9"], "MIT"),
        (["simulated/0-9", "kitti_odometry/00[0:250]"], "CC BY-NC-SA"),
        (["folder/mine"], "unknown"),
    ],
)
def test_licence_of(seen, licence):
    assert licence_of(seen).startswith(licence)


SCRIPT = """import sys
from pathlib import Path
from erfsfm.config import load_experiment
from erfsfm.training.run import train
if __name__ == '__main__':
    train(load_experiment(sys.argv[1]), Path(sys.argv[2]), '--resume' in sys.argv, device='cpu')
    print('trained')
"""


@pytest.mark.slow
def test_two_processes_are_one_with_twice_the_batch(both, tmp_path):
    """Batches of 2 in each of two processes; of 4 in one. Lightning starts the script again for a second device."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)

    def run(name: str, *resume: str, **training: Any) -> None:
        config, output = (
            both(training={"average_decay": 0.5} | training, data={"workers": 1}),
            tmp_path / name,
        )
        output.with_suffix(".yaml").write_text(dump_yaml(config))
        command = [sys.executable, script, output.with_suffix(".yaml"), output, *resume]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "trained\n", "by the first process alone"

    run("one", batch=4)
    run("two", batch=2, devices=2)
    for one, two in zip(
        weights_of(tmp_path / "one" / "last"), weights_of(tmp_path / "two" / "last"), strict=True
    ):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-5)
    records = [load_model(tmp_path / name / "last").record for name in ("one", "two")]
    assert records[0].metrics == pytest.approx(records[1].metrics, rel=1e-4, abs=1e-7)
    run("two", "--resume", batch=2, steps=6, devices=2)
    run("one", "--resume", batch=4, steps=6)
    for one, two in zip(
        weights_of(tmp_path / "one" / "last"), weights_of(tmp_path / "two" / "last"), strict=True
    ):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-4)  # Adam divides by small moments
