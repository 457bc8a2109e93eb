"""The output folder of a training run.

What may lie in it before a run begins, and what a resumed one needs.
"""

from __future__ import annotations

from pathlib import Path

from erfsfm.checkpoint import read_torch
from erfsfm.common.config_tree import read_yaml
from erfsfm.common.errors import ConfigError, TrainingError
from erfsfm.config import ExperimentConfig, load_experiment

CONFIG = "config.yaml"
MEASUREMENTS = "teacher"  # measured before a run begins, and kept if it is interrupted there
_BEGUN = {
    CONFIG,
    "checkpoints",
    "logs",
    "last",
    "best_pose",
}  # left by a run that failed before its first weights


class OutputFolder:
    """The folder of one run; one that holds files of others is never written to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint, self.config = path / "checkpoints" / "last.ckpt", path / CONFIG

    def require_free(self) -> None:
        """Accept a folder that is new, empty, or of a run that failed before its first checkpoint.

        Raises:
            TrainingError, ConfigError: a run with weights, or files that no training wrote; one line.
        """
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise TrainingError(
                f"--output {self.path} is a file, not a folder: choose another --output"
            )
        if self.checkpoint.is_file() or (self.path / "model.yaml").is_file():
            raise TrainingError(
                f"{self.path} holds a run already: continue with --resume or choose another --output"
            )
        names = {entry.name for entry in self.path.iterdir() if ".partial." not in entry.name} - {
            MEASUREMENTS
        }
        foreign = sorted(names - _BEGUN)
        if foreign:
            raise TrainingError(
                f"{self.path} holds files that 'erfsfm train' did not write ({foreign[0]}): choose a new or empty "
                "--output; nothing was changed"
            )
        if self.config.is_file():
            load_experiment(self.config)  # of another program it would be replaced

    def resumable_steps(self, config: ExperimentConfig) -> int:
        """Steps done at the last checkpoint.

        Raises:
            TrainingError: nothing to resume, or a damaged checkpoint; one line.
            ConfigError: the run began with another network, or with what the optimiser's state does not fit; one line.
        """
        for needed in (self.checkpoint, self.config):
            if not needed.is_file():
                raise TrainingError(
                    f"nothing to resume in {self.path}: no {needed.name}; start without --resume"
                )
        wrong = "is damaged or no checkpoint: start again in another --output"
        state = read_torch(self.checkpoint, TrainingError, wrong)
        known = {"global_step", "state_dict", "optimizer_states", "loops", "known"}
        is_whole = isinstance(state, dict) and known <= state.keys()
        if not is_whole or {name.partition(".")[0] for name in state["state_dict"]} != {
            "depth_net",
            "pose_net",
        }:
            raise TrainingError(f"{self.checkpoint} {wrong}")
        begun, wanted = (
            read_yaml(self.config),
            config.model_dump(mode="json"),
        )  # begun with settings of another version
        sections = (
            [begun.get(name) for name in ("network", "training")]
            if isinstance(begun, dict)
            else [None]
        )
        if not all(isinstance(section, dict) for section in sections):
            raise TrainingError(f"{self.config} is damaged: start again in another --output")
        if begun["network"] != wanted["network"]:
            raise ConfigError(
                f"the networks of {self.config} differ from this configuration: resume with the same one"
            )
        for key in ("networks", "frozen_stages"):
            before, now = begun["training"].get(key), wanted["training"][key]
            if before != now:
                raise ConfigError(
                    f"{self.config} began with training.{key} {before}; got {now}: resume with the same"
                )
        return int(state["global_step"])
