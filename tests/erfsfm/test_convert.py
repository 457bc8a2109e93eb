"""Checkpoints synthesised with the names of the published code, and the errors of malformed ones."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.checkpoint import load_model
from erfsfm.common.errors import CheckpointError
from erfsfm.convert import convert
from erfsfm.inference import DepthPosePredictor
from erfsfm.networks.deformable import deform_conv2d

QUARTER = 0.25
PLAIN, DILATED = frozenset[int](), frozenset({1, 2, 3, 4})
KERNELS = (7, 5, 3, 3, 3, 3, 3)


class OldDeformable(nn.Module):
    """The layer of the reference: three convolutions under its names."""

    def __init__(self, inside: int, outside: int, kernel: int, stride: int) -> None:
        super().__init__()
        options = {"kernel_size": kernel, "stride": stride, "padding": (kernel - 1) // 2}
        self.offset_conv = nn.Conv2d(inside, 2 * kernel**2, **options)
        self.modulator_conv = nn.Conv2d(inside, kernel**2, **options)
        self.regular_conv = nn.Conv2d(inside, outside, bias=False, **options)
        self.stride, self.padding = stride, options["padding"]

    def forward(self, x: Tensor) -> Tensor:
        mask = 2 * self.modulator_conv(x).sigmoid()
        kernel = self.regular_conv.weight
        return deform_conv2d(x, self.offset_conv(x), kernel, mask, self.stride, self.padding)


def _layer(
    inside: int, outside: int, kernel: int, stride: int, deformable: bool, dilation: int = 1
) -> nn.Module:
    if deformable:
        return OldDeformable(inside, outside, kernel, stride)
    return nn.Conv2d(inside, outside, kernel, stride, (kernel - 1) // 2, dilation)


class OldDisp(nn.Module):
    """DispNetS by the table of its layers, at a quarter of its width."""

    def __init__(self, deformable: frozenset[int] = PLAIN) -> None:
        super().__init__()
        planes = [8, 16, 32, 64, 128, 128, 128]
        ups = [128, 128, 64, 32, 16, 8, 4]
        for i, (inside, outside) in enumerate(zip([3, *planes], planes), start=1):
            k, bent = KERNELS[i - 1], i in deformable
            down, same = _layer(inside, outside, k, 2, bent), _layer(outside, outside, k, 1, bent)
            self.add_module(f"conv{i}", nn.Sequential(down, nn.ReLU(), same, nn.ReLU()))
        skips = [*reversed(planes[:-1]), 0]
        for n, (inside, outside, skip) in enumerate(zip([planes[-1], *ups], ups, skips)):
            level, coarser = 7 - n, int(n > 3)
            up = nn.ConvTranspose2d(inside, outside, 3, 2, 1, output_padding=1)
            self.add_module(f"upconv{level}", nn.Sequential(up, nn.ReLU()))
            both = nn.Conv2d(outside + skip + coarser, outside, 3, padding=1)
            self.add_module(f"iconv{level}", nn.Sequential(both, nn.ReLU()))
            if level <= 4:
                head = nn.Sequential(nn.Conv2d(outside, 1, 3, padding=1), nn.Sigmoid())
                self.add_module(f"predict_disp{level}", head)

    def forward(self, image: Tensor) -> Tensor:
        layer = dict(self.named_children())
        maps = [image]
        for i in range(1, 8):
            maps.append(layer[f"conv{i}"](maps[-1]))
        features, disparity = maps[7], None
        for level in range(7, 0, -1):
            size = maps[level - 1].shape[2:]
            parts = [layer[f"upconv{level}"](features)[..., : size[0], : size[1]]]
            if level > 1:
                parts.append(maps[level - 1])
            if disparity is not None:
                double = F.interpolate(
                    disparity, scale_factor=2, mode="bilinear", align_corners=False
                )
                parts.append(double[..., : size[0], : size[1]])
            features = layer[f"iconv{level}"](torch.cat(parts, 1))
            if level <= 4:
                disparity = 10 * layer[f"predict_disp{level}"](features) + 0.01
        assert disparity is not None
        return disparity


class OldPose(nn.Module):
    """PoseExpNet by the table of its layers, at a quarter of its width."""

    def __init__(
        self,
        deformable: frozenset[int] = PLAIN,
        dilated: frozenset[int] = PLAIN,
        sources: int = 4,
        masks: bool = False,
    ) -> None:
        super().__init__()
        self.sources = sources
        planes = [4, 8, 16, 32, 64, 64, 64]
        for i, (inside, outside) in enumerate(zip([3 + 3 * sources, *planes], planes), start=1):
            layer = _layer(
                inside, outside, KERNELS[i - 1], 2, i in deformable, 2 if i in dilated else 1
            )
            self.add_module(f"conv{i}", nn.Sequential(layer, nn.ReLU()))
        self.pose_pred = nn.Conv2d(planes[-1], 6 * sources, 1)
        if masks:
            ups = [64, 32, 16, 8, 4]
            for n, (inside, outside) in enumerate(zip([planes[4], *ups], ups)):
                self.add_module(
                    f"upconv{5 - n}",
                    nn.Sequential(nn.ConvTranspose2d(inside, outside, 4, 2, 1), nn.ReLU()),
                )
                if n:
                    self.add_module(
                        f"predict_mask{5 - n}", nn.Conv2d(outside, sources, 3, padding=1)
                    )

    def forward(self, images: Tensor) -> Tensor:
        layer = dict(self.named_children())
        maps = [images]
        for i in range(1, 8):
            maps.append(layer[f"conv{i}"](maps[-1]))
        return 0.01 * self.pose_pred(maps[7]).mean((2, 3)).view(-1, self.sources, 6)


def save(network: nn.Module, path: Path, *, legacy: bool = False, prefix: str = "") -> Path:
    state = {prefix + name: value for name, value in network.state_dict().items()}
    torch.save({"epoch": 7, "state_dict": state}, path, _use_new_zipfile_serialization=not legacy)
    return path


@pytest.fixture
def depth_file(tmp_path: Path) -> Path:
    return save(OldDisp(), tmp_path / "dispnet_model_best.pth.tar")


@pytest.fixture
def pose_file(tmp_path: Path) -> Path:
    return save(OldPose(), tmp_path / "exp_pose_model_best.pth.tar")


def refusal(*files: Path, output: Path | None = None, dilated: bool = False) -> str:
    with pytest.raises(CheckpointError) as caught:
        convert(files, output or files[0].parent / "converted", dilated)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("preset", "deformable"),
    [("depthnet", PLAIN), ("erf-depthnet-dfc", {1, 2, 3, 4}), ("erf-depthnet-dfcv2", {4, 5, 6, 7})],
)
def test_depth(tmp_path: Path, pose_file: Path, preset: str, deformable: frozenset[int]):
    old = OldDisp(frozenset(deformable)).eval()
    convert([save(old, tmp_path / "disp.pth.tar"), pose_file], tmp_path / "new")
    model = load_model(tmp_path / "new")
    assert model.record.network.depth == preset
    assert model.record.network.depth_width == QUARTER
    wanted, found = (
        list(old.state_dict().values()),
        list(model.networks["depth"].state_dict().values()),
    )
    assert sorted(v.sum().item() for v in wanted) == sorted(v.sum().item() for v in found), (
        "every value, once"
    )
    image = torch.rand(1, 3, 64, 128) * 2 - 1
    with torch.no_grad():
        torch.testing.assert_close(model.networks["depth"](image), old(image), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("preset", "deformable", "dilated", "masks", "sources"),
    [
        pytest.param("posenet", PLAIN, PLAIN, False, 4, marks=pytest.mark.slow),
        pytest.param("erf-posenet-dilated", PLAIN, DILATED, True, 2, marks=pytest.mark.slow),
        ("erf-posenet-dfc", {3, 4, 5, 6, 7}, PLAIN, False, 4),
        pytest.param("erf-posenet-dfcv2", {1, 2, 3, 4}, PLAIN, True, 2, marks=pytest.mark.slow),
    ],
)
def test_pose(
    tmp_path: Path,
    preset: str,
    deformable: frozenset[int],
    dilated: frozenset[int],
    masks: bool,
    sources: int,
):
    old = OldPose(frozenset(deformable), dilated, sources, masks).eval()
    convert([save(old, tmp_path / "pose.pth.tar")], tmp_path / "new", dilated=bool(dilated))
    model = load_model(tmp_path / "new")
    network = model.record.network
    assert (network.pose, network.sources, network.fidelity) == (preset, sources, "paper")
    images = list(torch.rand(1 + sources, 1, 3, 64, 128) * 2 - 1)
    with torch.no_grad():
        pose = old(torch.cat(images, dim=1))
        torch.testing.assert_close(
            model.networks["pose"](images[0], images[1:]), pose, rtol=1e-5, atol=1e-7
        )


def test_the_record(tmp_path: Path, depth_file: Path, pose_file: Path):
    convert(
        [pose_file, depth_file],
        tmp_path / "new",
        size=(94, 310),
        trained_on=["kitti_odometry/00"],
        command="me",
    )
    record = load_model(tmp_path / "new").record
    assert (record.network.height, record.network.width) == (94, 310)
    assert (record.trained_on, record.command, record.networks) == (
        ["kitti_odometry/00"],
        "me",
        "both",
    )
    convert([pose_file, depth_file], tmp_path / "unknown")
    assert load_model(tmp_path / "unknown").record.trained_on == ["unknown"]


def test_one_network_alone(tmp_path: Path, depth_file: Path):
    convert([depth_file], tmp_path / "new")
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        "depth.safetensors",
        "model.yaml",
    ]
    model = load_model(tmp_path / "new")
    assert [*model.networks] == ["depth"]
    predictor = DepthPosePredictor.from_weights(tmp_path / "new")
    image = np.zeros((64, 128, 3), np.uint8)
    assert predictor.depth(image).shape == (64, 128)
    with pytest.raises(CheckpointError, match="holds no pose network"):
        predictor.poses([image] * 5)


class Malicious:
    """Would leave a file behind when unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("form", ["zip", "legacy", "pickle", "hidden"])
def test_nothing_is_executed(tmp_path: Path, form: str):
    path, trace = tmp_path / "evil.pth.tar", tmp_path / "trace"
    state: dict[str, object] = dict(OldDisp().state_dict())
    if form == "pickle":
        path.write_bytes(pickle.dumps(Malicious(trace)))
    else:
        payload = (
            {"state_dict": state, "epoch": Malicious(trace)}
            if form != "hidden"
            else state | {"x": Malicious(trace)}
        )
        torch.save(payload, path, _use_new_zipfile_serialization=form != "legacy")
    message = refusal(path)
    assert "would execute code" in message
    assert not trace.exists()
    torch.load(path, weights_only=False) if form != "pickle" else pickle.loads(path.read_bytes())
    assert trace.exists(), "the payload runs where code is allowed"


def _edited(path: Path, **changes: Tensor | None) -> Path:
    state = torch.load(path, weights_only=True)["state_dict"]
    for name, value in changes.items():
        name = name.replace("__", ".")
        if value is None:
            del state[name]
        else:
            state[name] = value
    torch.save(state, path)
    return path


def test_other_networks(tmp_path: Path, depth_file: Path, pose_file: Path):
    torch.save({"encoder.conv1.weight": torch.zeros(1)}, tmp_path / "resnet.pth.tar")
    assert "neither DispNetS nor PoseExpNet" in refusal(tmp_path / "resnet.pth.tar")
    assert "both hold a depth network" in refusal(depth_file, depth_file)
    assert "another architecture" in refusal(_edited(depth_file, iconv3__0__weight=None))
    assert "which DispNetS and PoseExpNet do not have" in refusal(
        _edited(pose_file, conv8__0__weight=torch.zeros(2))
    )
