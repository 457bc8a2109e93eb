"""Rotations measured in the images replace a pose network's guess, and nothing else does."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from erfsfm.geometry import euler_to_rotation, pose_vector_to_matrix
from erfsfm.networks.image_alignment import CENTRE, FOCAL, align, aligned, cell_rays, project, rotation_to_euler, solve
from erfsfm.networks.onnx_graph import OnnxGraph
from erfsfm.networks.presets import build

HEIGHT, WIDTH = 128, 416
K = np.array([[FOCAL[0] * WIDTH, 0, CENTRE[0] * WIDTH], [0, FOCAL[1] * HEIGHT, CENTRE[1] * HEIGHT], [0, 0, 1]])
FIRST_PIXEL = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centres are whole numbers


def texture(seed: int) -> np.ndarray:
    """Smooth noise ``(H, W, 3)`` uint8."""
    coarse = np.random.default_rng(seed).uniform(0, 255, (HEIGHT // 5, WIDTH // 5, 3))
    return np.clip(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] / 127.5 - 1


def turned(image: np.ndarray, R_turned_camera: np.ndarray) -> np.ndarray:
    H = np.linalg.inv(FIRST_PIXEL) @ K @ R_turned_camera @ np.linalg.inv(K) @ FIRST_PIXEL
    return cv2.warpPerspective(image, H, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def snippet(degrees: Tensor, seed: int = 0) -> tuple[Tensor, list[Tensor]]:
    """A target, and sources turned by Euler angles ``(4, 3)``."""
    image = texture(seed)
    rotations = euler_to_rotation(torch.deg2rad(degrees).double()).numpy()
    return tensor(image), [tensor(turned(image, R)) for R in rotations]


def errors_deg(vectors: Tensor, degrees: Tensor) -> Tensor:
    """Angles ``(4,)`` between rotations of ``(1, 4, 6)`` and true ones."""
    relative = pose_vector_to_matrix(vectors[0])[:, :3, :3].mT @ euler_to_rotation(torch.deg2rad(degrees))
    cosine = (relative.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    return torch.rad2deg(cosine.clamp(-1, 1).arccos())


TURNS = torch.tensor([[0.4, -3.0, 0.2], [0.2, -1.5, 0.1], [-0.1, 1.2, 0.1], [-0.3, 3.1, -0.4]])


@pytest.mark.parametrize("seed", range(3))
def test_turns_that_nobody_guessed_are_found(seed: int) -> None:
    target, sources = snippet(TURNS, seed)
    vectors = aligned(torch.zeros(1, 4, 6), target, sources)
    assert errors_deg(vectors, TURNS).max() < 0.1
    assert vectors[..., :3].abs().max() == 0


def test_snippets_of_a_batch_do_not_mix() -> None:
    snippets = [snippet(turns, seed) for seed, turns in enumerate((TURNS, -TURNS))]
    guess = torch.rand(2, 4, 6, generator=torch.Generator().manual_seed(0)) / 100
    target = torch.cat([each[0] for each in snippets])
    both = aligned(guess, target, [torch.cat(images) for images in zip(*(each[1] for each in snippets))])
    alone = [aligned(guess[k : k + 1], *snippets[k]) for k in range(2)]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-5, rtol=0)


def test_a_path_bends_with_the_measured_turns() -> None:
    """Equal steps on a circle, whatever turns were guessed: the direction of travel is that of the camera halfway."""
    yaw, step = math.radians(1.5), torch.tensor([0.0004, -0.0002, 0.004])
    circle = [torch.eye(4)]
    for _ in range(4):
        ahead, half = torch.eye(4), torch.tensor([0.0, yaw / 2, 0.0])
        ahead[:3, :3], ahead[:3, 3] = euler_to_rotation(2 * half), euler_to_rotation(half) @ step
        circle.append(circle[-1] @ ahead)  # T_first_k
    T_k_target = [torch.linalg.inv(T_first_k) @ circle[2] for T_first_k in circle if T_first_k is not circle[2]]
    true = torch.stack(T_k_target)
    target, sources = snippet(torch.rad2deg(torch.tensor([[0, yaw * k, 0] for k in (2, 1, -1, -2)])))
    guess = torch.cat([torch.stack([k * step for k in (2, 1, -1, -2)]), torch.zeros(4, 3)], -1)[None]
    measured = pose_vector_to_matrix(aligned(guess, target, sources)[0])
    torch.testing.assert_close(measured[:, :3, :3], true[:, :3, :3], atol=1e-3, rtol=0)
    torch.testing.assert_close(measured[:, :3, 3], true[:, :3, 3], atol=1e-5, rtol=0)


def test_a_network_guesses_in_training_and_measures_afterwards() -> None:
    target, sources = snippet(TURNS)
    plain, network = build("posenet", width=0.1), build("posenet", width=0.1, alignment="images")
    network.load_state_dict(plain.state_dict())
    with torch.no_grad():
        assert torch.equal(network.train()(target, sources), plain.train()(target, sources))
        guess, measured = plain.eval()(target, sources), network.eval()(target, sources)
    assert errors_deg(guess, TURNS).max() > 2 and errors_deg(measured, TURNS).max() < 0.1


@pytest.mark.slow
@torch.inference_mode()
def test_its_graph_has_the_same_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    network = build("posenet", width=0.1, alignment="images").eval()
    graph = OnnxGraph(lambda: network, 1, "a network")
    for seed in range(2):
        target, sources = snippet(TURNS * (1 - 2 * seed), seed)
        output = graph(target.numpy(), [source.numpy() for source in sources])
        assert np.abs(output - network(target, sources).numpy()).max() < math.radians(0.01)


ROWS, COLUMNS = 16, 52
STEPS = (100.0, 6.0, 3.0, 3.0, 2.0, 2.0)


@pytest.fixture
def rays() -> torch.Tensor:
    return cell_rays(ROWS, COLUMNS, torch.device("cpu"))


@pytest.fixture
def inverse_depth() -> torch.Tensor:
    return torch.rand(2, ROWS * COLUMNS, generator=torch.Generator().manual_seed(0)) + 0.05


def truth() -> tuple[torch.Tensor, torch.Tensor]:
    euler = torch.tensor([[0.01, 0.12, -0.01], [0.0, -0.03, 0.0]])
    return euler_to_rotation(euler), torch.tensor([[0.01, 0.0, -0.1], [0.0, 0.0, 0.06]])


def found(seen, rays, value, sigma=0.1):
    start = torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3)
    return align(seen, torch.full_like(seen, 0.5), rays, (value, sigma * value), start, STEPS)


def test_exact_matches_give_the_motion(rays, inverse_depth):
    R, t = truth()
    seen = project(rays, inverse_depth, R, t)[1]
    R_found, t_found = found(seen, rays, inverse_depth)
    torch.testing.assert_close(R_found, R, atol=2e-4, rtol=0)
    torch.testing.assert_close(t_found, t, atol=2e-3, rtol=0)


def test_matches_that_move_along_do_not_count(rays, inverse_depth):
    R, t = truth()
    seen = project(rays, inverse_depth, R, t)[1]
    cars = torch.rand(ROWS * COLUMNS, generator=torch.Generator().manual_seed(1)) < 0.2
    seen[:, cars, 0] += 0.1
    R_found, _ = found(seen, rays, inverse_depth)
    angle = (R_found.transpose(1, 2) @ R - torch.eye(3)).norm(dim=(1, 2)) / 2**0.5
    assert (angle < 2e-3).all()


def test_an_uncertain_depth_turns_the_camera_less(rays, inverse_depth):
    R, t = truth()
    seen = project(rays, inverse_depth, R, t)[1]
    wrong = torch.where(rays[:, 0] > 0.3, 0.5 * inverse_depth, inverse_depth)  # one side seems twice as far

    def angle(sigma: float) -> float:
        R_found, _ = found(seen, rays, wrong, sigma)
        return float((R_found.transpose(1, 2) @ R - torch.eye(3)).norm())

    assert angle(0.5) < 0.7 * angle(0.02)


def test_linear_systems_and_angles():
    generator = torch.Generator().manual_seed(2)
    roots = torch.randn(3, 6, 6, generator=generator)
    A, b = roots @ roots.transpose(1, 2) + torch.eye(6), torch.randn(3, 6, generator=generator)
    torch.testing.assert_close(solve(A, b), torch.linalg.solve(A, b), atol=1e-4, rtol=1e-3)
    euler = 0.3 * torch.randn(5, 3, generator=generator)
    torch.testing.assert_close(rotation_to_euler(euler_to_rotation(euler)), euler)
