"""The training step compared with a plain implementation of the same loss: ``make benchmark``.

The plain implementation loops over the sources and uses PyTorch's own pooling; both must give the same loss.
Nothing here asserts a time.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.checkpoint import build_networks
from erfsfm.config import ExperimentConfig
from erfsfm.training.objective import SnippetBatch, evaluate_objective

pytestmark = pytest.mark.slow
LOSSES: dict[str, dict[str, Any]] = {
    "paper: L1, second-order smoothness": {},
    "SSIM, edge-aware smoothness": {
        "ssim_weight": 0.85,
        "smoothness": "disparity-edge-aware",
        "smoothness_weight": 0.005,
    },
}


def rotation(euler: Tensor) -> Tensor:
    """Rx Ry Rz of (B, 3) angles as a product of three matrices."""
    R = torch.eye(3).expand(len(euler), 3, 3)
    for axis in range(3):
        c, s = euler[:, axis].cos(), euler[:, axis].sin()
        one, zero = torch.ones_like(c), torch.zeros_like(c)
        turns = {
            0: (one, zero, zero, zero, c, -s, zero, s, c),
            1: (c, zero, s, zero, one, zero, -s, zero, c),
            2: (c, -s, zero, s, c, zero, zero, zero, one),
        }
        R = R @ torch.stack(turns[axis], dim=1).view(-1, 3, 3)
    return R


def structural(a: Tensor, b: Tensor) -> Tensor:
    """(1 - SSIM) / 2 of (B, 1, H, W)."""
    a, b = F.pad(a, (1, 1, 1, 1), "reflect"), F.pad(b, (1, 1, 1, 1), "reflect")
    mean_a, mean_b = F.avg_pool2d(a, 3, 1), F.avg_pool2d(b, 3, 1)
    var_a, var_b = F.avg_pool2d(a**2, 3, 1) - mean_a**2, F.avg_pool2d(b**2, 3, 1) - mean_b**2
    covariance = F.avg_pool2d(a * b, 3, 1) - mean_a * mean_b
    above = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    return ((1 - above / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))) / 2).clamp(0, 1)


def plain_loss(depth_net: nn.Module, pose_net: nn.Module, batch: SnippetBatch, config: ExperimentConfig) -> Tensor:
    loss, total = config.loss, torch.zeros(())
    sources = batch.sources.unbind(dim=1)
    disparities = depth_net(batch.target * 2 - 1)
    poses = pose_net(batch.target * 2 - 1, [source * 2 - 1 for source in sources])
    full_h, full_w = batch.target.shape[-2:]
    for level, disparity in enumerate(disparities):
        h, w = disparity.shape[-2:]
        target = F.interpolate(batch.target, (h, w), mode="area")
        K = batch.K.clone()
        K[:, 0] *= w / full_w
        K[:, 1] *= h / full_h
        K[:, :2, 2] += 0.5 * torch.tensor([w / full_w, h / full_h]) - 0.5
        depth = 1 / disparity
        v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        rays = torch.stack((u, v, torch.ones_like(u))).float().flatten(1)
        points = torch.inverse(K) @ rays * depth.flatten(2)
        for k, source in enumerate(sources):
            moved = rotation(poses[:, k, 3:]) @ points + poses[:, k, :3, None]
            seen = K @ moved
            x, y = seen[:, 0] / seen[:, 2].clamp(min=1e-3), seen[:, 1] / seen[:, 2].clamp(min=1e-3)
            grid = torch.stack((2 * x / (w - 1) - 1, 2 * y / (h - 1) - 1), dim=-1)
            slack = 1 + 1e-3 / torch.tensor([w - 1, h - 1])
            valid = ((grid.abs() <= slack).all(dim=-1) & (moved[:, 2] > 1e-3)).view(-1, 1, h, w)
            warped = F.grid_sample(
                F.interpolate(source, (h, w), mode="area"),
                grid.clamp(-2, 2).view(-1, h, w, 2),
                padding_mode="border",
                align_corners=True,
            )
            error = (target - warped).abs().mean(dim=1, keepdim=True)
            if loss.ssim_weight:
                grey = target.mean(dim=1, keepdim=True), warped.mean(dim=1, keepdim=True)
                error = loss.ssim_weight * structural(*grey) + (1 - loss.ssim_weight) * error
            total = total + (error * valid).mean()
        total = total + loss.smoothness_weight / 2**level * rough(disparity, target, loss.smoothness)
    return total


def rough(disparity: Tensor, image: Tensor, kind: str) -> Tensor:
    def dx(x: Tensor) -> Tensor:
        return x[..., 1:] - x[..., :-1]

    def dy(x: Tensor) -> Tensor:
        return x[..., 1:, :] - x[..., :-1, :]

    if kind == "depth-second-order":
        d = 1 / disparity
        return sum((part.abs().mean() for part in (dx(dx(d)), dy(dx(d)), dx(dy(d)), dy(dy(d)))), torch.zeros(()))
    d = disparity / (disparity.mean(dim=(2, 3), keepdim=True) + 1e-7)
    weights = [torch.exp(-change(image).abs().mean(dim=1, keepdim=True)) for change in (dx, dy)]
    return (dx(d).abs() * weights[0]).mean() + (dy(d).abs() * weights[1]).mean()


@pytest.mark.parametrize("name", LOSSES)
def test_training_step_beside_a_plain_loss(name: str, cpu_ms: Callable[..., list[float]]) -> None:
    """Forward, loss, backward and Adam; batch 4 at 416x128 with four sources, the plain pair at full width."""
    smooth = F.interpolate(torch.rand(20, 3, 16, 52), (128, 416), mode="bicubic").clamp(0, 1).view(4, 5, 3, 128, 416)
    K = torch.tensor([[240.0, 0, 207.5], [0, 240.0, 63.5], [0, 0, 1]]).expand(4, 3, 3)
    batch = SnippetBatch(smooth[:, 2], smooth[:, [0, 1, 3, 4]], K)
    config = ExperimentConfig.model_validate({"loss": LOSSES[name]})
    depth_net, pose_net = build_networks(config.network)
    weights = [*depth_net.parameters(), *pose_net.parameters()]
    optimiser = torch.optim.Adam(weights, lr=1e-6)

    def ours() -> Tensor:
        return evaluate_objective(depth_net, pose_net, batch, config).total

    def plain() -> Tensor:
        return plain_loss(depth_net, pose_net, batch, config)

    def step(objective: Callable[[], Tensor]) -> Callable[[], None]:
        def work() -> None:
            optimiser.zero_grad()
            objective().backward()
            optimiser.step()

        return work

    torch.testing.assert_close(ours(), plain(), rtol=1e-4, atol=0)
    for mine, other in zip(torch.autograd.grad(ours(), weights), torch.autograd.grad(plain(), weights)):
        assert (mine - other).norm() <= 0.01 * other.norm()
    mine_ms, other_ms = cpu_ms(step(ours), step(plain), runs=5)
    print(f"\n\n| training step ({name}) | CPU ms | ratio |\n|---|---:|---:|")
    print(f"| plain implementation | {other_ms:.0f} | 1.00 |\n| ours | {mine_ms:.0f} | {mine_ms / other_ms:.2f} |")
