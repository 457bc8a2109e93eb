"""Processor time of the parts that a user waits for, as ratios within one run: ``make benchmark``.

Nothing here asserts a time; machines are shared and differ.
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from erfsfm.losses.photometric import box_mean
from erfsfm.networks.presets import build

pytestmark = pytest.mark.slow
SIZE = (4, 3, 128, 416)


def cpu_ms(work: Callable[[], object], runs: int = 3) -> float:
    """Median processor time of a call, milliseconds, after one call to warm up."""
    work()
    times = []
    for _ in range(runs):
        start = time.process_time()
        work()
        times.append((time.process_time() - start) * 1e3)
    return statistics.median(times)


def test_networks_forward_and_backward() -> None:
    torch.set_num_threads(1)
    image, sources = torch.rand(SIZE) * 2 - 1, [torch.rand(SIZE) * 2 - 1 for _ in range(4)]

    def pair(depth: str, pose: str) -> float:
        depth_net, pose_net = build(depth), build(pose)

        def step() -> None:
            loss = sum(d.mean() for d in depth_net(image)) + pose_net(image, sources).mean()
            loss.backward()

        return cpu_ms(step)

    plain = pair("depthnet", "posenet")
    print(f"\n{'depth + pose, forward + backward, batch 4, 416x128':60}{plain:9.0f} ms   1.00")
    for depth, pose in (
        ("depthnet", "erf-posenet-dilated"),
        ("depthnet", "erf-posenet-dfc"),
        ("depthnet", "erf-posenet-dfcv2"),
        ("erf-depthnet-dilated", "posenet"),
        ("erf-depthnet-dfcv2", "posenet"),
        ("erf-depthnet-dfc", "posenet"),
    ):
        cost = pair(depth, pose)
        print(f"{depth + ' + ' + pose:60}{cost:9.0f} ms {cost / plain:6.2f}")
        assert np.isfinite(cost)


def test_box_mean_against_pooling() -> None:
    torch.set_num_threads(1)
    x = torch.rand(16, 3, 130, 418)
    ours, pooling = cpu_ms(lambda: box_mean(x), 9), cpu_ms(lambda: F.avg_pool2d(x, 3, 1), 9)
    print(f"\n3 x 3 mean of 16 x 3 x 130 x 418: ours {ours:.1f} ms, avg_pool2d {pooling:.1f} ms")
    torch.testing.assert_close(box_mean(x), F.avg_pool2d(x, 3, 1))


def test_simulated_street() -> None:
    from slam.sequences.simulated import SimulatedStreet, SimulationOptions

    street = SimulatedStreet(SimulationOptions(frames=250, seed=700))
    cost = cpu_ms(lambda: [street.render(k) for k in range(0, 250, 10)]) / 25
    print(f"\na frame of the simulated street, 416x128: {cost:.1f} ms, {1000 / cost:.0f} frames a second")
    assert street.render(0).image.shape == (128, 416, 3)
