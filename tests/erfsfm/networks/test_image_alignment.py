"""Rotations measured in the images replace a pose network's guess, and nothing else does."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from erfsfm.geometry.alignment import CENTRE, FOCAL
from erfsfm.geometry.transforms import euler_to_rotation, pose_vector_to_matrix
from erfsfm.networks.image_alignment import aligned
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


@torch.inference_mode()
def test_its_graph_has_the_same_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    network = build("posenet", width=0.1, alignment="images").eval()
    graph = OnnxGraph(lambda: network, 1, "a network")
    for seed in range(2):
        target, sources = snippet(TURNS * (1 - 2 * seed), seed)
        output = graph(target.numpy(), [source.numpy() for source in sources])
        assert np.abs(output - network(target, sources).numpy()).max() < math.radians(0.01)
