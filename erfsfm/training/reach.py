"""Which weights a training step reaches, found on PyTorch's device ``meta``, which has shapes and computes nothing."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from erfsfm.config import ExperimentConfig
from erfsfm.training.module import SelfSupervision


def without_gradient(config: ExperimentConfig) -> list[str]:
    """Names of the trained weights that some step leaves without a gradient, as terms and scales that are off do.

    Forward, loss and backward of a step run for it, which takes up to some seconds. What would wait for the device, or
    mix devices, is an error on ``meta``.
    """
    steps = [config]
    if config.teacher.alone_steps > 0:
        teacher = config.teacher.model_copy(update={"alone_steps": 0})
        steps.append(config.model_copy(update={"teacher": teacher}))
    missing: dict[str, None] = {}
    for each in steps:
        with torch.device("meta"):
            module, batch = SelfSupervision(each), _batch(each)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that nothing is logged without a trainer
            module.training_step(batch, 0).backward()
        weights = module.named_parameters()
        missing |= dict.fromkeys(name for name, weight in weights if weight.requires_grad and weight.grad is None)
    return [*missing]


def _batch(config: ExperimentConfig) -> dict[str, Tensor]:
    """A batch as the loader stacks it, on the default device."""
    network, training = config.network, config.training
    targets, size = training.batch, (network.height, network.width)
    snippets = targets - training.of_batch(config.data.exact)
    batch = {"target": torch.empty(targets, 3, *size), "K": torch.empty(targets, 3, 3)}
    if config.teacher.views == "many" or config.teacher.weights:
        batch |= {bound: torch.empty(targets, 1, *size) for bound in ("least", "most")}
    if config.single_images:
        return batch
    batch["sources"] = torch.empty(snippets, network.sources, 3, *size)
    if "least" in batch:
        batch["T_source_target"] = torch.empty(snippets, network.sources, 4, 4)
    if config.data.weather > 0:
        batch["shown"] = torch.empty(snippets, network.sources + 1, 3, *size)
    return batch
