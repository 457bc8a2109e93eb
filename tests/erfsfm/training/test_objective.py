"""The objective on a scene whose depth and motion are known."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from erfsfm.config import ExperimentConfig, load_experiment
from erfsfm.geometry import pose_vector_to_matrix
from erfsfm.training.objective import ObjectiveResult, SnippetBatch, evaluate_objective

PLACES = [(-0.3, 0.05, -0.4), (0.2, -0.1, 0.35)]  # of the two sources; the target is at the origin


class FixedDepth(nn.Module):
    """One disparity everywhere, whatever the image."""

    def __init__(self, disparity: float, levels: int = 4) -> None:
        super().__init__()
        self.levels = levels
        self.disparity = nn.Parameter(torch.tensor(disparity, dtype=torch.float64))

    def forward(self, image: Tensor) -> list[Tensor]:
        height, width = image.shape[-2:]
        sizes = [(math.ceil(height / 2**s), math.ceil(width / 2**s)) for s in range(self.levels)]
        return [self.disparity.expand(len(image), 1, *size) for size in sizes]


class FixedPose(nn.Module):
    """The same motion whatever the images."""

    def __init__(self, vectors: Tensor) -> None:
        super().__init__()
        self.vectors = nn.Parameter(vectors)

    def forward(self, target: Tensor, sources: list[Tensor]) -> Tensor:
        assert len(sources) == self.vectors.shape[0]
        return self.vectors.expand(len(target), -1, -1)


def true_poses() -> Tensor:
    """``T_source_target`` of cameras that do not rotate: minus their positions."""
    return torch.tensor([[*(-np.array(place)), 0, 0, 0] for place in PLACES], dtype=torch.float64)


def experiment(fidelity: str = "default", **loss: Any) -> ExperimentConfig:
    return ExperimentConfig.model_validate(
        {"network": {"sources": 2, "fidelity": fidelity}, "loss": {"smoothness_weight": 0.0} | loss}
    )


@pytest.fixture
def batch(plane) -> SnippetBatch:
    def tensor(place: Any) -> Tensor:
        return torch.from_numpy(plane.colours(np.array(place))).permute(2, 0, 1)

    target = tensor((0, 0, 0))[None].expand(2, -1, -1, -1)
    sources = torch.stack([tensor(place) for place in PLACES])[None].expand(2, -1, -1, -1, -1)
    return SnippetBatch(
        target, sources, torch.from_numpy(plane.camera.K)[None].double().expand(2, 3, 3)
    )


def evaluate(
    batch: SnippetBatch,
    config: ExperimentConfig,
    disparity: float,
    vectors: Tensor,
    levels: int = 4,
) -> ObjectiveResult:
    depth_net, pose_net = (
        FixedDepth(disparity, levels).requires_grad_(False),
        FixedPose(vectors).requires_grad_(False),
    )
    return evaluate_objective(depth_net, pose_net, batch, config)


@pytest.mark.parametrize("reduction", ["mean", "minimum"])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.85])
def test_the_true_depth_and_motion_have_the_least_loss(batch, plane, reduction, ssim_weight):
    config = experiment(reduction=reduction, ssim_weight=ssim_weight)
    truth = float(evaluate(batch, config, 1 / plane.distance, true_poses(), 2).total)
    assert 0 <= truth < 0.02
    turned = true_poses()
    turned[:, 4] = 0.05
    wrong = {
        "too near": evaluate(batch, config, 1.4 / plane.distance, true_poses(), 2),
        "too far": evaluate(batch, config, 0.6 / plane.distance, true_poses(), 2),
        "backwards": evaluate(batch, config, 1 / plane.distance, -true_poses(), 2),
        "turned": evaluate(batch, config, 1 / plane.distance, turned, 2),
        "swapped": evaluate(batch, config, 1 / plane.distance, true_poses().flip(0), 2),
    }
    for name, outcome in wrong.items():
        assert float(outcome.total) > 2 * truth, name


def test_networks_get_the_weather_and_the_error_is_of_the_clear_images(batch, plane):
    seen: list[Tensor] = []

    class Watching(FixedDepth):
        def forward(self, image: Tensor) -> list[Tensor]:
            seen.append(image)
            return super().forward(image)

    class WatchingPose(FixedPose):
        def forward(self, target: Tensor, sources: list[Tensor]) -> Tensor:
            seen.extend([target, *sources])
            return super().forward(target, sources)

    shown = torch.rand(2, 3, 3, 64, 96, dtype=torch.float64)
    clear = evaluate(batch, experiment(), 1 / plane.distance, true_poses())
    nets = Watching(1 / plane.distance), WatchingPose(true_poses())
    wet = evaluate_objective(*nets, replace(batch, shown=shown), experiment())
    assert float(wet.total.detach()) == float(clear.total)
    assert len(seen) == 4
    expected = [shown[:, 1], shown[:, 1], shown[:, 0], shown[:, 2]]
    assert all(torch.equal(image, 2 * part - 1) for image, part in zip(seen, expected))


@pytest.mark.parametrize("reduction", ["mean", "minimum"])
def test_gradient_points_towards_truth(batch, plane, reduction):
    for factor in (0.9, 1.1):
        depth_net = FixedDepth(factor / plane.distance)
        pose_net = FixedPose(factor * true_poses())
        evaluate_objective(
            depth_net, pose_net, batch, experiment(reduction=reduction)
        ).total.backward()
        assert depth_net.disparity.grad is not None
        assert pose_net.vectors.grad is not None
        assert float(depth_net.disparity.grad) * (factor - 1) > 0
        assert float((pose_net.vectors.grad * true_poses()).sum()) * (factor - 1) > 0


def bilinear(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Look-up in ``(H, W, 3)`` at pixel (x, y) inside it."""
    column, row = min(int(x), image.shape[1] - 2), min(int(y), image.shape[0] - 2)
    a, b = x - column, y - row
    top = (1 - a) * image[row, column] + a * image[row, column + 1]
    bottom = (1 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1 - b) * top + b * bottom


def naive_photometric(batch: SnippetBatch, disparities: list[Tensor], vectors: np.ndarray) -> float:
    """The reference's loss pixel by pixel: mean |target - warp| valid of images in [-1, 1], over scales and sources."""
    total = 0.0
    for level, disparity in enumerate(disparities):
        ratio = 2**level
        height, width = disparity.shape[-2:]
        for b, K_full in enumerate(batch.K.numpy()):
            K = K_full.copy()
            K[:2] /= ratio

            def shrink(image: Tensor) -> np.ndarray:
                blocks = (2 * image.numpy() - 1).reshape(3, height, ratio, width, ratio)  # noqa: B023
                return blocks.mean(axis=(2, 4)).transpose(1, 2, 0)

            target = shrink(batch.target[b])
            for n, vector in enumerate(vectors):
                source = shrink(batch.sources[b, n])
                R = Rotation.from_euler("XYZ", vector[3:]).as_matrix()
                error = np.zeros((height, width))
                for v in range(height):
                    for u in range(width):
                        depth = 1 / float(disparity[b, 0, v, u])
                        X = R @ (depth * np.linalg.solve(K, [u, v, 1])) + vector[:3]
                        x, y, _ = K @ X / X[2]
                        if 0 <= x <= width - 1 and 0 <= y <= height - 1:
                            error[v, u] = np.abs(target[v, u] - bilinear(source, x, y)).mean()
                total += error.mean() / len(batch.K)
    return total


def test_mean_is_the_papers_formula():
    generator = torch.Generator().manual_seed(5)
    disparities = [
        torch.rand(2, 1, 32 >> s, 40 >> s, generator=generator).double() * 0.2 + 0.1
        for s in range(4)
    ]
    vectors = torch.tensor(
        [[0.4, -0.2, 0.5, 0.02, -0.05, 0.03], [-0.6, 0.1, -0.7, -0.02, 0.04, 0.1]]
    ).double()
    K = torch.tensor(
        [[[35.0, 0, 19], [0, 33, 17], [0, 0, 1]], [[45.0, 0, 21], [0, 44, 15], [0, 0, 1]]]
    ).double()
    images = torch.rand(2, 3, 3, 32, 40, generator=generator).double()
    batch = SnippetBatch(images[:, 0], images[:, 1:], K)

    class Given(nn.Module):
        def forward(self, image: Tensor) -> list[Tensor]:
            return disparities

    outcome = evaluate_objective(
        Given(), FixedPose(vectors).requires_grad_(False), batch, experiment(fidelity="paper")
    )
    expected = naive_photometric(batch, disparities, vectors.numpy())
    assert float(outcome.terms["photometric"]) == pytest.approx(expected, rel=1e-9)
    assert float(outcome.total) == pytest.approx(expected, rel=1e-9), (
        "smoothness has no weight here"
    )


def test_a_row_of_the_paper_weighs_its_terms_as_the_reference_does():
    """Grey 0.3 beside 0.5 is 0.4 apart in [-1, 1]: 0.4 of each source and scale, and 0.2 of the smoothness."""

    class Parabola(nn.Module):
        def forward(self, image: Tensor) -> list[Tensor]:
            return [
                1 / (torch.arange(64 >> s) ** 2 + 1).double().expand(1, 1, 32 >> s, 64 >> s)
                for s in range(4)
            ]

    K = torch.tensor([[[40.0, 0, 32], [0, 40, 16], [0, 0, 1]]]).double()
    images = torch.full((1, 5, 3, 32, 64), 0.5).double()
    batch = SnippetBatch(torch.full((1, 3, 32, 64), 0.3).double(), images[:, 1:], K)
    still = FixedPose(torch.zeros(4, 6).double()).requires_grad_(False)
    outcome = evaluate_objective(
        Parabola(), still, batch, load_experiment("table1-posenet-416x128")
    )
    smoothness = 2 * (1 + 1 / 2 + 1 / 4 + 1 / 8)
    assert float(outcome.total) == pytest.approx(0.4 * 4 * 4 + 0.2 * smoothness)


def test_minimum_tolerates_an_occluded_source(batch, plane):
    sources = batch.sources.clone()
    sources[:, 0, :, 20:40, 30:60] = 0
    hidden = SnippetBatch(batch.target, sources, batch.K)
    for reduction, forgives in (("minimum", True), ("mean", False)):
        config = experiment(reduction=reduction)
        clear = float(evaluate(batch, config, 1 / plane.distance, true_poses()).total)
        covered = float(evaluate(hidden, config, 1 / plane.distance, true_poses()).total)
        assert (covered < 1.5 * clear) is forgives


def test_no_visible_points_no_loss(batch):
    """All points behind both sources: no error, and gradients that are numbers."""
    vectors = torch.tensor([[0, 0, -100.0, 0, 0, 0]] * 2).double()
    for reduction in ("minimum", "mean"):
        pose_net, depth_net = FixedPose(vectors), FixedDepth(0.25)
        config = experiment(reduction=reduction, ssim_weight=0.85)
        outcome = evaluate_objective(depth_net, pose_net, batch, config)
        outcome.total.backward()
        assert float(outcome.total.detach()) == 0
        assert pose_net.vectors.grad is not None
        assert torch.isfinite(pose_net.vectors.grad).all()


def test_the_mask_keeps_what_moves(batch, plane):
    """A passenger's view: the left half travels with the camera, the right half passes by."""
    sources = batch.sources.clone()
    sources[..., :48] = batch.target[:, None, :, :, :48]
    half_still = SnippetBatch(batch.target, sources, batch.K)
    config = experiment(reduction="minimum")
    depth_net = FixedDepth(1.1 / plane.distance)
    evaluate_objective(depth_net, FixedPose(true_poses()), half_still, config).total.backward()
    assert depth_net.disparity.grad is not None
    assert float(depth_net.disparity.grad) > 0, (
        "the moving half still gives a gradient towards larger depth"
    )
    plain = evaluate(half_still, experiment(reduction="mean"), 1 / plane.distance, true_poses())
    masked = evaluate(half_still, config, 1 / plane.distance, true_poses())
    assert float(masked.total) < 0.3 * float(plain.total), (
        "the still half adds no error at the true depth"
    )


@pytest.mark.parametrize("reduction", ["mean", "minimum"])
def test_what_is_fixed_to_the_camera_has_no_error(batch, reduction):
    """The lower half is hidden by something that no motion explains."""
    half = batch.target.shape[2] // 2
    fixed = torch.zeros_like(batch.target[:, :1], dtype=torch.bool)
    fixed[:, :, half:] = True
    target = batch.target.clone()
    target[:, :, half:] = torch.rand_like(target[:, :, half:])
    config, depth = experiment(reduction=reduction, ssim_weight=0.0), 1 / 2.0
    known, other = (
        evaluate(
            SnippetBatch(image, batch.sources, batch.K, fixed=fixed), config, depth, true_poses()
        )
        for image in (batch.target, target)
    )
    assert float(known.terms["photometric"]) == pytest.approx(float(other.terms["photometric"]))


def test_autocast_does_not_reach_the_geometry(plane, batch):
    single = SnippetBatch(batch.target.float(), batch.sources.float(), batch.K.float())
    config = experiment(ssim_weight=0.85)
    depth_net, pose_net = FixedDepth(1 / plane.distance).float(), FixedPose(true_poses().float())
    precise = evaluate_objective(depth_net, pose_net, single, config)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = evaluate_objective(depth_net, pose_net, single, config)
    assert mixed.total.dtype == torch.float32
    assert torch.equal(mixed.total, precise.total)


def _taught(views: str = "many", networks: str = "both", **loss: Any) -> ExperimentConfig:
    return ExperimentConfig.model_validate(
        {
            "network": {"sources": 2},
            "loss": {"photometric_weight": 0, "smoothness_weight": 0} | loss,
            "training": {"networks": networks},
            "teacher": {
                "views": views,
                "rotation_weight": 1,
                "translation_weight": 1,
                "structure_weight": 1,
                "edge_weight": 1,
            },
        }
    )


@pytest.mark.parametrize("views", ["exact", "many"])
def test_labels_have_one_unit_that_depth_and_motion_must_have(batch, views):
    vectors = torch.tensor(
        [[0.3, 0.0, -0.1, 0.0, 0.1, 0.0], [-0.3, 0.0, 0.1, 0.0, -0.1, 0.0]]
    ).double()
    height, width = batch.target.shape[-2:]
    half = torch.full((2, 1, height, width), 0.5).double()
    T_source_target = pose_vector_to_matrix(vectors * torch.tensor([10.0] * 3 + [1] * 3))[
        None
    ].expand(2, 2, 4, 4)
    right = replace(batch, T_source_target=T_source_target, bounds=(0.098 * half, 0.102 * half))
    assert evaluate(right, _taught(views), 0.5, vectors).total.item() == pytest.approx(0, abs=1e-3)
    for term, vector in {"translation": vectors * 2, "rotation": -vectors}.items():
        assert evaluate(right, _taught(views), 0.5, vector).terms[term].item() > 0.1
    twice = evaluate(right, _taught(views), 1.0, vectors)
    middle, half_width = math.sqrt(0.098 * 0.102), math.log(0.102 / 0.098) / 2
    assert twice.terms["structure"].item() == pytest.approx(
        math.log(0.2 / middle) - half_width / 2, rel=1e-3
    )
    assert twice.terms["translation"].item() == pytest.approx(
        0, abs=1e-3
    )  # the unit is not the depth's


def test_many_views_warp_the_images_by_the_measured_motion(batch, plane):
    in_heights = true_poses() * torch.tensor([10.0] * 3 + [1] * 3)
    T_source_target = pose_vector_to_matrix(in_heights)[None].expand(2, 2, 4, 4)
    shape = (2, 1, *batch.target.shape[-2:])
    unbounded = (torch.zeros(shape).double(), torch.full(shape, torch.inf).double())
    labelled = replace(batch, T_source_target=T_source_target, bounds=unbounded)
    config = _taught("many", "depth", photometric_weight=1)
    still = torch.zeros(2, 6).double()
    right, wrong = (
        float(evaluate(labelled, config, factor / plane.distance, still).terms["photometric"])
        for factor in (1.0, 1.3)
    )
    assert right < 0.5 * wrong
