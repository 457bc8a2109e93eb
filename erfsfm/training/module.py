"""The Lightning module: one optimisation step, and what a validation measures."""

from __future__ import annotations

import math
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor

from erfsfm.checkpoint import build_networks
from erfsfm.config import ExperimentConfig
from erfsfm.errors import TrainingError
from erfsfm.evaluation.depth_metrics import depth_errors
from erfsfm.evaluation.pose_metrics import snippet_errors, snippet_from_network
from erfsfm.geometry.transforms import pose_vector_to_matrix
from erfsfm.geometry.warp import project_into_source, sample
from erfsfm.losses.photometric import photometric_error
from erfsfm.losses.structure import Bounds
from erfsfm.training.objective import SnippetBatch, evaluate_objective, to_network_range


class SelfSupervision(lightning.LightningModule):
    """Depth and pose networks trained together from the photometric error between frames."""

    def __init__(self, config: ExperimentConfig) -> None:
        super().__init__()
        self.config = config
        plain = config.loss.model_copy(update={"ssim_weight": 0.0, "reduction": "mean", "auto_mask": False})
        self._warm_up = config.model_copy(update={"loss": plain})
        unlooked = config.loss.model_copy(update={"photometric_weight": 0.0})
        self._alone = config.model_copy(update={"loss": unlooked})
        self.depth_net, self.pose_net = build_networks(config.network)
        self.validation_metrics: dict[str, float] = {}
        self._validation: dict[str, list[float]] = {}

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """The objective of one batch; stops the run where it is not a number."""
        bounds = Bounds(batch["least"], batch["most"]) if "least" in batch else None
        snippets = SnippetBatch(batch["target"], batch["sources"], batch["K"], batch.get("T_source_target"), bounds)
        outcome = evaluate_objective(self.depth_net, self.pose_net, snippets, self._present())
        if not torch.isfinite(outcome.total):
            parts = ", ".join(f"{name} {value.item():.3g}" for name, value in outcome.terms.items())
            raise TrainingError(
                f"the loss at step {self.global_step} is not finite ({parts}): lower training.learning_rate or set "
                "training.gradient_clip, then go on with --resume"
            )
        self.log("loss", outcome.total.detach(), prog_bar=True)
        self.log_dict({f"loss/{name}": value.detach() for name, value in outcome.terms.items()})
        if self.global_step % (20 * self.config.training.log_every) == 0:
            self._log_pictures(snippets, outcome.disparities[0], outcome.warped)
        return outcome.total

    def _present(self) -> ExperimentConfig:
        """The configuration with the objective of this step."""
        if self.global_step < self.config.teacher.alone_steps:
            return self._alone
        return self._warm_up if self.global_step < self.config.loss.warm_up_steps else self.config

    def configure_optimizers(self) -> Any:
        """Adam on both networks; the schedule counts steps."""
        training = self.config.training
        optimiser = torch.optim.Adam(self.parameters(), lr=training.learning_rate, betas=(0.9, 0.999))
        if training.schedule == "constant":
            return optimiser
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimiser, lambda step: 0.02 + 0.98 * (1 + math.cos(math.pi * min(step / training.steps, 1))) / 2
        )
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_validation_epoch_start(self) -> None:
        """Forget the last validation."""
        self._validation = {}

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """Photometric error of every snippet; depth and pose errors where truth is known."""
        target, sources = to_network_range(batch["target"]), to_network_range(batch["sources"])
        disparity = self.depth_net(target).float()
        vectors = self.pose_net(target, list(sources.unbind(dim=1))).float()
        T_source_target = pose_vector_to_matrix(vectors)
        with torch.autocast(self.device.type, enabled=False):
            self._note("photometric", _reconstruction_error(batch, disparity, T_source_target))
        self._note("disparity_spread", float(disparity.std() / disparity.mean()))
        if "depth" in batch:
            truth = batch["depth"][0].cpu().numpy()
            resized = torch.nn.functional.interpolate(disparity, truth.shape, mode="bilinear")
            errors = depth_errors((1 / resized)[0, 0].cpu().numpy(), truth)
            if errors is not None:
                self._note("abs_rel", errors.abs_rel)
                self._note("depth_scale", errors.scale)
        if "T_source_target" in batch and len(T_source_target[0]) == 4:
            predicted = snippet_from_network(T_source_target[0].double().cpu().numpy())[None]
            true = snippet_from_network(batch["T_source_target"][0].cpu().numpy())[None]
            errors_pose = snippet_errors(predicted, true)
            self._note("snippet_ate", errors_pose.ate_mean)
            self._note("snippet_re", errors_pose.re_mean)

    def on_validation_epoch_end(self) -> None:
        """Mean of every measure; the spread of the depth scale is what a SLAM system lives on."""
        means = {name: float(np.mean(values)) for name, values in self._validation.items()}
        scales = np.array(self._validation.get("depth_scale", []))
        if len(scales) > 1:
            means["depth_scale_spread"] = float(scales.std() / scales.mean())
        self.validation_metrics = means
        self.log_dict({f"validation/{name}": value for name, value in means.items()})

    def _note(self, name: str, value: float) -> None:
        self._validation.setdefault(name, []).append(value)

    def _log_pictures(self, snippets: SnippetBatch, disparity: Tensor, warped: Tensor | None) -> None:
        """Input, a warped source and the disparity of the first sample, for TensorBoard."""
        for logger in self.loggers:
            if isinstance(logger, lightning.pytorch.loggers.TensorBoardLogger):
                shown = disparity[0] / disparity[0].max()
                board = logger.experiment
                board.add_image("target", snippets.target[0], self.global_step)
                if warped is not None:
                    board.add_image("source warped", warped[0, len(warped[0]) // 2].clamp(0, 1), self.global_step)
                board.add_image("disparity", shown, self.global_step)


def _reconstruction_error(batch: dict[str, Tensor], disparity: Tensor, T_source_target: Tensor) -> float:
    """Mean over pixels of the smallest error among the sources (0.85 SSIM), whatever the training loss is."""
    count = T_source_target.shape[1]
    depth = (1 / disparity).repeat_interleave(count, dim=0)
    projection = project_into_source(depth, T_source_target.flatten(0, 1), batch["K"].repeat_interleave(count, 0))
    warped = sample(batch["sources"].flatten(0, 1), projection)
    error = photometric_error(batch["target"].repeat_interleave(count, 0), warped, 0.85)
    error = error.masked_fill(~projection.valid, torch.inf).unflatten(0, (-1, count)).amin(dim=1)
    return float(error[torch.isfinite(error)].mean())
