"""The Lightning module: optimisation step and validation metrics."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Self

import lightning
import numpy as np
import torch
from torch import Tensor, nn

from erfsfm.checkpoint import build_networks
from erfsfm.common.errors import TrainingError
from erfsfm.config import ExperimentConfig, NetworkKind, TrainedNetworks
from erfsfm.evaluation.depth_metrics import depth_errors
from erfsfm.evaluation.pose_metrics import snippet_errors, snippet_from_network
from erfsfm.geometry import pose_vector_to_matrix
from erfsfm.model_record import DepthInput
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.networks.lite0 import Lite0Conv, Lite0DepthNet
from erfsfm.training.objective import Level, SnippetBatch, evaluate_objective, to_network_range

# Spread of a disparity map (standard deviation over mean) below which it is a constant; fresh networks have 0.04.
_CONSTANT = 1e-3
_CONSTANT_STEPS = 100
_WARM_UP = 300  # steps, or a twentieth of the run; Adam's first ones at full rate made weights 5 to 16 % worse


class SelfSupervision(lightning.LightningModule):
    """Depth and pose networks trained together from the photometric error between frames.

    Args:
        config: the experiment.
        clock: seconds that the loop has taken, earlier parts of a resumed run included.
    """

    def __init__(self, config: ExperimentConfig, clock: Callable[[], float] = lambda: 0.0) -> None:
        super().__init__()
        self.config = config
        self._clock = clock
        self.depth_net, self.pose_net = build_networks(config.network).values()
        self.known: TrainedNetworks = (
            config.training.networks
        )  # those that are trained here, or were before
        self.depth_input: DepthInput | None = None  # of the network that this training goes on with
        # networks, and the stages of pretrained encoders, that keep their weights
        self.depth_net.requires_grad_(config.training.networks != "pose")
        self.pose_net.requires_grad_(config.training.networks != "depth")
        if isinstance(self.depth_net, Lite0DepthNet):
            self.depth_net.encoder.stages[: config.training.frozen_stages].requires_grad_(
                False
            )  # the stem being one
            # depthwise convolutions are a quarter faster so
            self.depth_net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.train()  # Lightning keeps the mode of each module
        self.loss = math.nan  # of the latest step
        self.validation_metrics: dict[str, float] = {}
        self._validation: dict[str, list[float]] = {}
        self._constant_steps = 0

    def network(self, kind: NetworkKind) -> nn.Module:
        """The network of that kind."""
        return self.depth_net if kind == "depth" else self.pose_net

    def on_after_batch_transfer(
        self, batch: dict[str, Tensor], dataloader_idx: int
    ) -> dict[str, Tensor]:
        """Colour to [0, 1] where the networks are; samples hold it as uint8, a quarter of the bytes to hand over."""
        return {
            name: each.float() / 255 if each.dtype == torch.uint8 else each
            for name, each in batch.items()
        }

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """The loss of one batch; `on_after_backward` stops the run where it is not finite or the depth a constant."""
        bounds = (batch["least"], batch["most"]) if "least" in batch else None
        none = batch["target"].new_zeros(0, self.config.network.sources, *batch["target"].shape[1:])
        sources = batch.get("sources", none)
        snippets = SnippetBatch(
            batch["target"],
            sources,
            batch["K"],
            batch.get("T_source_target"),
            bounds,
            batch.get("shown"),
            batch.get("fixed"),
        )
        result = evaluate_objective(self.depth_net, self.pose_net, snippets, self.config)
        self._terms = {name: value.detach() for name, value in result.terms.items()}
        # largest spread of the disparity in an image, standard deviation over mean; infinite without depth
        spread = result.total.new_full((), torch.inf)
        if result.disparities:
            finest = result.disparities[0].detach()
            spread = (finest.std(dim=(1, 2, 3)) / finest.mean(dim=(1, 2, 3))).amax()
        self._watched = torch.stack([result.total.detach(), spread])
        self.log("loss", self._watched[0])
        self.log_dict({f"loss/{name}": value for name, value in self._terms.items()})
        return result.total

    def on_after_backward(self) -> None:
        """Read loss and spread of the depth, means over all processes, in one wait for the device.

        Raises:
            TrainingError: the loss is not finite, or the depth has been constant for many steps.
        """
        self.loss, spread = self.trainer.strategy.reduce(self._watched, reduce_op="mean").tolist()
        if not math.isfinite(self.loss):
            parts = ", ".join(f"{name} {value.item():.3g}" for name, value in self._terms.items())
            raise TrainingError(
                f"the loss at step {self.global_step} is not finite ({parts}): lower training.learning_rate or set "
                "training.gradient_clip, then continue with --resume, or start again where the last checkpoint is bad "
                "already; the weights so far are in last/"
            )
        self._constant_steps = self._constant_steps + 1 if spread < _CONSTANT else 0
        self.require_depth(_CONSTANT_STEPS)

    def require_depth(self, steps: int = 1) -> None:
        """Refuse a depth that has been constant for the last ``steps``.

        Raises:
            TrainingError: it has.
        """
        if self._constant_steps >= steps:
            raise TrainingError(
                f"the depth has been one constant for {self._constant_steps} steps at step {self.global_step}: "
                "nothing is learned from it; lower training.learning_rate or loss.smoothness_weight and start "
                "again; the weights so far are in last/"
            )

    def train(self, mode: bool = True) -> Self:
        """Training mode, except for a network that is not trained: its batch statistics would drift."""
        super().train(mode)
        kept = {"depth": self.pose_net, "pose": self.depth_net}.get(self.config.training.networks)
        if kept is not None:
            kept.eval()
        return self

    def configure_optimizers(self) -> Any:
        """Adam on the trained parameters; the schedule counts steps."""
        training = self.config.training
        offsets = [
            parameter
            for layer in self.modules()
            if isinstance(layer, DeformableConv2d)
            for branch in (layer.offset, layer.modulator)
            for parameter in branch.parameters()
            if parameter.requires_grad
        ]
        encoders = [m for m in self.modules() if isinstance(m, Lite0Conv)]
        pretrained = [p for encoder in encoders for p in encoder.parameters() if p.requires_grad]
        slow = {id(parameter) for parameter in [*offsets, *pretrained]}
        rest = [p for p in self.parameters() if id(p) not in slow and p.requires_grad]
        slowly: list[dict[str, Any]] = [
            {"params": offsets, "lr": training.learning_rate * training.offset_rate},
            {"params": pretrained, "lr": training.learning_rate * training.encoder_rate},
        ]
        slowly = slowly[: 2 if pretrained else 1]
        optimiser = torch.optim.Adam(
            [{"params": rest}, *slowly], lr=training.learning_rate, betas=(0.9, 0.999)
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimiser,
            lambda step: learning_rate_factor(training.schedule, self.progress(step), step),
        )
        self._rates = list(schedule.base_lrs)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_train_start(self) -> None:
        """Learn at the configured rates. Until here, a resumed run has the rates of its checkpoint."""
        schedule: Any = self.lr_schedulers()
        schedule.base_lrs = self._rates
        done = schedule.last_epoch
        factor = learning_rate_factor(self.config.training.schedule, self.progress(done), done)
        for group, rate in zip(schedule.optimizer.param_groups, self._rates, strict=True):
            group["initial_lr"] = rate
            group["lr"] = rate * factor

    def progress(self, step: int) -> float:
        """Fraction of the run that is done, by steps or by time, whichever is farther."""
        training = self.config.training
        by_time = self._clock() / (60 * training.minutes) if training.minutes else 0.0
        return min(max(step / training.steps, by_time), 1)

    def on_validation_epoch_start(self) -> None:
        """Start a new validation."""
        self._validation = {}

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """Photometric error of every snippet; depth and pose errors where ground truth is known.

        A network that was never trained is not run.
        """
        target, sources = to_network_range(batch["target"]), to_network_range(batch["sources"])
        disparity = T_source_target = None
        if self.known != "pose":
            disparity = self.depth_net(target).float()
            self._note_depth(disparity, batch.get("depth"))
        if self.known != "depth":
            T_source_target = pose_vector_to_matrix(
                self.pose_net(target, list(sources.unbind(dim=1))).float()
            )
            self._note_poses(T_source_target, batch.get("T_source_target"))
        if disparity is not None and T_source_target is not None:
            with torch.autocast(self.device.type, enabled=False):
                # the smallest error among the sources (0.85 SSIM), whatever the training loss is
                level = Level(batch["target"], batch["sources"], batch["K"], disparity)
                errors, valid = level.errors(T_source_target, 0.85)
                error = errors.masked_fill(~valid, torch.inf).amin(dim=1)
                self._note("photometric", float(error[torch.isfinite(error)].mean()))

    def _note_depth(self, disparity: Tensor, true_depth: Tensor | None) -> None:
        self._note("disparity_spread", float(disparity.std() / disparity.mean()))
        if true_depth is None:
            return
        truth = true_depth[0].cpu().numpy()
        resized = torch.nn.functional.interpolate(disparity, truth.shape, mode="bilinear")
        errors = depth_errors((1 / resized)[0, 0].cpu().numpy(), truth)
        if errors is not None:
            self._note("abs_rel", errors.abs_rel)
            self._note("depth_scale", errors.scale)

    def _note_poses(self, T_source_target: Tensor, true_poses: Tensor | None) -> None:
        if true_poses is None:
            return
        predicted = snippet_from_network(T_source_target[0].double().cpu().numpy())[None]
        errors = snippet_errors(predicted, snippet_from_network(true_poses[0].cpu().numpy())[None])
        self._note("snippet_ate", errors.ate_mean)
        self._note("snippet_re", errors.re_mean)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Note which networks were trained, and the size of single images."""
        checkpoint["known"] = self.known
        checkpoint["depth_input"] = self.depth_input and self.depth_input.model_dump()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take over which networks were trained, and the size of single images."""
        self.known = checkpoint["known"]
        depth_input = checkpoint.get("depth_input")
        self.depth_input = DepthInput.model_validate(depth_input) if depth_input else None

    def on_validation_epoch_end(self) -> None:
        """Note and log what the first process measured, by which all of them decide what to keep."""
        self.validation_metrics = self.trainer.strategy.broadcast(self.measured())
        self.log_dict(
            {f"validation/{name}": value for name, value in self.validation_metrics.items()}
        )

    def measured(self) -> dict[str, float]:
        """Mean of every metric, and the spread of the depth scale, which limits a SLAM system's scale drift."""
        means = {name: float(np.mean(values)) for name, values in self._validation.items()}
        scales = np.array(self._validation.get("depth_scale", []))
        if len(scales) > 1:
            means["depth_scale_spread"] = float(scales.std() / scales.mean())
        return means

    def _note(self, name: str, value: float) -> None:
        self._validation.setdefault(name, []).append(value)


def decisive(metrics: dict[str, float], networks: TrainedNetworks = "both") -> float:
    """The metric of a validation: error of depth, of poses where these alone are trained; less is better.

    Without ground truth it is the photometric error, which needs both networks; else infinite.
    """
    value = metrics.get(
        "snippet_ate" if networks == "pose" else "abs_rel", metrics.get("photometric", math.inf)
    )
    return value if math.isfinite(value) else math.inf


def learning_rate_factor(schedule: str, progress: float, step: int = _WARM_UP) -> float:
    """Factor on the learning rate after a fraction of the run; a cosine ends at 2 % and begins with a warm-up."""
    if schedule == "constant":
        return 1.0
    risen = min(max((step + 1) / _WARM_UP, 20 * progress), 1)
    return risen * (0.51 + 0.49 * math.cos(math.pi * progress))
