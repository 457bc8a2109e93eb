"""Inference: inputs and outputs of the networks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from erfsfm.checkpoint import Model, build_networks, save_model
from erfsfm.config import NetworkConfig
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import DepthInput, ModelRecord

RNG = np.random.default_rng(3)


def model(sources: Literal[2, 4] = 4, pose: str = "posenet") -> Model:
    config = NetworkConfig(
        depth_width=0.0625, pose=pose, pose_width=0.125, height=32, width=64, sources=sources
    )
    torch.manual_seed(0)
    return Model(
        ModelRecord(network=config, trained_on=["kitti_odometry/00[0:250]"]), build_networks(config)
    )


@pytest.fixture
def predictor() -> DepthPosePredictor:
    return DepthPosePredictor.of(model())


def image(height: int = 40, width: int = 70) -> NDArray[np.uint8]:
    return RNG.integers(0, 256, (height, width, 3), dtype=np.uint8)


class Echo(nn.Module):
    """Disparity that is the red channel; poses that are each source's mean colours."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Tensor] = []

    def forward(self, image: Tensor, sources: list[Tensor] | None = None) -> Tensor:
        self.seen.append(image)
        if sources is None:
            return (image[:, :1] + 1) / 2 + 0.1
        rows = [torch.cat([s.mean(dim=(2, 3)), torch.zeros(1, 3)], dim=1) for s in sources]
        return torch.stack(rows, dim=1)


def echo(sources: Literal[2, 4] = 4) -> tuple[DepthPosePredictor, Echo]:
    net = Echo()
    return DepthPosePredictor.of(Model(model(sources).record, {"depth": net, "pose": net})), net


def test_networks_see_rgb_from_minus_one_to_one():
    predictor, net = echo()
    red = np.zeros((32, 64, 3), np.uint8)
    red[..., 0] = 255
    depth = predictor.depth(red)
    assert net.seen[0].shape == (1, 3, 32, 64)
    assert net.seen[0][0, :, 0, 0].tolist() == [1, -1, -1]
    np.testing.assert_allclose(depth, 1 / 1.1, rtol=1e-6)


def test_disparity_is_what_is_interpolated():
    predictor, _ = echo()
    split = np.zeros((32, 64, 3), np.uint8)
    split[:, 32:, 0] = 255
    depth = predictor.depth(np.repeat(np.repeat(split, 3, 0), 3, 1))
    between = depth[48, 95:97]  # a pixel left and right of the edge, at thirds between 0.1 and 1.1
    np.testing.assert_allclose(between, [1 / (0.1 + 1 / 3), 1 / (0.1 + 2 / 3)], rtol=1e-5)


def flat(value: int) -> NDArray[np.uint8]:
    return np.full((20, 30, 3), value, np.uint8)


@pytest.mark.parametrize("sources", [2, 4])
def test_rows_follow_the_sources_in_time_order(sources: int):
    predictor, net = echo(sources)
    values = [51 * k for k in range(sources + 1)]
    T_source_target = predictor.poses([flat(value) for value in values])
    middle = values.pop(sources // 2)
    assert float(net.seen[0].mean()) == pytest.approx(middle / 127.5 - 1, abs=1e-6), "the target"
    np.testing.assert_allclose(T_source_target[:, 0, 3], [v / 127.5 - 1 for v in values], atol=1e-6)


def test_a_single_image_may_be_seen_at_another_size_than_in_training():
    larger = DepthInput(height=64, width=128, disparity=0.5)
    plain = model()
    record = plain.record.model_copy(update={"depth_input": larger})
    predictor = DepthPosePredictor.of(Model(record, plain.networks))
    large = image(64, 128)
    with torch.inference_mode():
        seen = torch.from_numpy(large.transpose(2, 0, 1)[None] / np.float32(127.5) - 1)
        output = plain.networks["depth"](seen)[0, 0].numpy()
    np.testing.assert_allclose(predictor.depth(large), 2 / output, rtol=1e-5)
    assert predictor.disparity(large).shape == (32, 64)


def test_a_prepared_image_gives_the_bytes_of_the_image(predictor: DepthPosePredictor):
    frames = [image() for _ in range(5)]
    prepared = [predictor.prepare(frame) for frame in frames]
    assert prepared[0].shape == (1, 3, 32, 64)
    np.testing.assert_array_equal(predictor.disparity(prepared[0]), predictor.disparity(frames[0]))
    np.testing.assert_array_equal(predictor.poses(prepared), predictor.poses(frames))
    mixed = [prepared[0], *frames[1:4], prepared[4]]
    np.testing.assert_array_equal(predictor.poses(mixed), predictor.poses(frames))


def test_onnx_runtime_has_the_same_outputs_up_to_rounding(tmp_path: Path):
    frames = [image() for _ in range(5)]
    save_model(tmp_path, model())
    plain = DepthPosePredictor.from_weights(tmp_path)
    for _ in range(2):
        fast = DepthPosePredictor.from_weights(tmp_path, runtime="onnx")
        np.testing.assert_allclose(fast.depth(frames[0]), plain.depth(frames[0]), rtol=1e-4)
        np.testing.assert_allclose(fast.poses(frames), plain.poses(frames), atol=1e-4)


def test_kept_graphs_need_no_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save_model(tmp_path / "weights", model())
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    predictor = DepthPosePredictor.from_weights(tmp_path / "weights", runtime="onnx")
    grey = np.full((32, 64, 3), 90, np.uint8)
    first = str(predictor.depth(grey).sum()), str(predictor.poses([grey] * 5).sum())
    program = """
import sys
import numpy as np
from erfsfm.inference import DepthPosePredictor
predictor = DepthPosePredictor.from_weights(sys.argv[1], "auto", "onnx")
grey = np.full((32, 64, 3), 90, np.uint8)
print(predictor.depth(grey).sum(), predictor.poses([grey] * 5).sum(), "torch" in sys.modules)
"""
    command = [sys.executable, "-c", program, str(tmp_path / "weights")]
    second = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert second == [*first, "False"]


def test_from_weights(tmp_path: Path):
    made = model()
    save_model(tmp_path, made)
    loaded = DepthPosePredictor.from_weights(tmp_path)
    frame = image()
    np.testing.assert_array_equal(loaded.depth(frame), DepthPosePredictor.of(made).depth(frame))
    assert len(loaded.sha256) == 64
    assert loaded.sources == 4
    assert DepthPosePredictor.from_weights(str(tmp_path)).record == loaded.record


def test_leaks(predictor: DepthPosePredictor):
    names = [
        "kitti_odometry/00[249:260]",
        "kitti_odometry/00[250:260]",
        "kitti_raw/2011_10_03_drive_0027",
    ]
    assert predictor.leaks(names) == [names[0], names[2]]
