"""Processor time of the parts that a user waits for, as ratios within one run: ``make benchmark``.

Nothing here asserts a time; machines are shared and differ.
"""

import statistics
import time
from collections.abc import Callable

import pytest
import torch

from erfsfm.networks.presets import build

pytestmark = pytest.mark.slow
SIZE = (4, 3, 128, 416)
PAIRS = (
    ("depthnet", "posenet"),
    ("depthnet", "erf-posenet-dilated"),
    ("depthnet", "erf-posenet-dfc"),
    ("depthnet", "erf-posenet-dfcv2"),
    ("erf-depthnet-dilated", "posenet"),
    ("erf-depthnet-dfcv2", "posenet"),
    ("erf-depthnet-dfc", "posenet"),
)


Clock = Callable[..., list[float]]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def cpu_ms() -> Clock:
    """Median processor time of each call, milliseconds, after one call to warm up.

    They take turns, so that a machine that slows down slows all of them down.
    """

    def measure(*works: Callable[[], object], runs: int = 3) -> list[float]:
        times: list[list[float]] = [[] for _ in works]
        for run in range(runs + 1):
            for work, spent in zip(works, times):
                start = time.process_time()
                work()
                if run:
                    spent.append((time.process_time() - start) * 1e3)
        return [statistics.median(spent) for spent in times]

    return measure


def test_networks_forward_and_backward(cpu_ms: Clock):
    image, sources = torch.rand(SIZE) * 2 - 1, [torch.rand(SIZE) * 2 - 1 for _ in range(4)]
    networks = {name: build(name) for pair in PAIRS for name in pair}

    def step(depth: str, pose: str) -> Callable[[], None]:
        def work() -> None:
            loss = (
                sum(d.mean() for d in networks[depth](image))
                + networks[pose](image, sources).mean()
            )
            loss.backward()

        return work

    costs = cpu_ms(*(step(*pair) for pair in PAIRS))
    print("\n\n| depth network | pose network | CPU ms | ratio |\n|---|---|---:|---:|")
    for (depth, pose), cost in zip(PAIRS, costs):
        print(f"| {depth} | {pose} | {cost:.0f} | {cost / costs[0]:.2f} |")


def test_simulated_street(cpu_ms: Clock):
    from slam.simulation.options import SimulationOptions
    from slam.simulation.street import SimulatedStreet

    street = SimulatedStreet(SimulationOptions(frames=250, seed=700))
    cost = cpu_ms(lambda: [street.render(k) for k in range(0, 250, 10)])[0] / 25
    print("\n\n| simulated street, 416x128 | CPU ms a frame | frames a second |\n|---|---:|---:|")
    print(f"| rendering | {cost:.1f} | {1000 / cost:.0f} |")
    assert street.render(0).shape == (128, 416, 3)
