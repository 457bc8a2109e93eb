"""Muon for matrices, steps of equal size in every direction (Jordan et al. 2024), and Adam for other parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

_MOMENTUM = 0.95
_BETAS = (0.9, 0.999)
_EPSILON = 1e-8
_ITERATIONS = 5
_QUINTIC = (3.4445, -4.7750, 2.0315)  # drives singular values into 0.7 to 1.2 (Jordan et al. 2024)
_STEP_RMS = 0.2  # of an entry, for a learning rate of one: about what Adam's steps have (Liu et al. 2025)


class Muon(torch.optim.Optimizer):
    """Muon for the groups with ``orthogonal: True``, Adam for the others, in one optimiser with one state.

    A convolution's kernel counts as a matrix with a row per output channel. Its averaged gradient is replaced by the
    nearest orthogonal matrix, so that directions with small gradients are learned as fast as those with large ones.

    Args:
        groups: parameters with ``lr`` and ``orthogonal``; an orthogonal group's have two or more dimensions.
        lr: of groups that name none.
    """

    def __init__(self, groups: Iterable[dict[str, Any]], lr: float) -> None:
        super().__init__(groups, {"lr": lr, "orthogonal": False})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step along the gradients; what the closure returns."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            step = self._orthogonal_step if group["orthogonal"] else self._adam_step
            for parameter in group["params"]:
                if parameter.grad is not None:
                    parameter.add_(step(parameter, parameter.grad), alpha=-group["lr"])
        return loss

    def _orthogonal_step(self, parameter: Tensor, gradient: Tensor) -> Tensor:
        state = self.state[parameter]
        if not state:
            state["average"] = torch.zeros_like(parameter)
        average: Tensor = state["average"].lerp_(gradient, 1 - _MOMENTUM)
        matrix = orthogonalised(gradient.lerp(average, _MOMENTUM).flatten(1))
        scaled: Tensor = matrix.view_as(parameter) * (_STEP_RMS * max(matrix.shape) ** 0.5)
        return scaled

    def _adam_step(self, parameter: Tensor, gradient: Tensor) -> Tensor:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state["average"], state["square"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        state["step"] += 1
        steps = float(state["step"])
        average: Tensor = state["average"].lerp_(gradient, 1 - _BETAS[0]) / (1 - _BETAS[0] ** steps)
        square: Tensor = state["square"].lerp_(gradient.square(), 1 - _BETAS[1]) / (1 - _BETAS[1] ** steps)
        return average / (square.sqrt() + _EPSILON)


def orthogonalised(matrix: Tensor) -> Tensor:
    """A matrix ``(R, C)`` with the same singular vectors and all singular values about one, by Newton-Schulz steps."""
    wide = matrix.shape[0] <= matrix.shape[1]
    X: Tensor = matrix if wide else matrix.T
    X = X / (X.norm() + 1e-7)
    a, b, c = _QUINTIC
    for _ in range(_ITERATIONS):
        A = X @ X.T
        X = a * X + (b * A + c * (A @ A)) @ X
    return X if wide else X.T


def is_matrix(parameter: nn.Parameter) -> bool:
    """Whether it is a kernel with several outputs: not a bias, a norm's gain or a head of one channel."""
    return parameter.dim() >= 2 and parameter.shape[0] > 1
