"""Boards rendered with a known camera: every pixel's ray is met with the board, twice as fine as the image."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.commands.board import Board

_FINE = 2
_TEXEL_PX = 24  # of the texture, a square
_MARGIN = 1  # squares of white around the board


@dataclass(frozen=True)
class Studio:
    """A camera in front of a board."""

    board: Board = field(default_factory=lambda: Board(9, 6, 0.03))
    model: str = "opencv"
    width: int = 480
    height: int = 360
    camera: tuple[float, ...] = (390.0, 394.0, 248.0, 175.0)
    distortion: tuple[float, ...] = (-0.25, 0.08, 0.0005, -0.0003, 0.0)

    @property
    def K(self) -> np.ndarray:
        fx, fy, cx, cy = self.camera
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def picture(self, tilt_deg: tuple[float, float, float], place_m: tuple[float, float, float]) -> np.ndarray:
        """The grey image of the board, turned about its middle, at a place before the camera."""
        R = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix()
        rays = rays_of(self.model, self.width, self.height, self.camera, self.distortion)
        t = np.array(place_m) - R @ self.board.corners_m.mean(axis=0)
        # x, y of the board at the ray's depth: two rows of R^T (z ray - t)
        along = rays @ R
        depth = (R[:, 2] @ t) / along[:, 2]
        squares = (along[:, :2] * depth[:, None] - t @ R[:, :2]) / self.board.square_m + 1 + _MARGIN
        texels = (squares * _TEXEL_PX - 0.5).astype(np.float32).reshape(self.height * _FINE, self.width * _FINE, 2)
        fine = cv2.remap(texture(self.board), texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, borderValue=110)
        return cv2.resize(fine, (self.width, self.height), interpolation=cv2.INTER_AREA)


@functools.cache
def rays_of(
    model: str, width: int, height: int, camera: tuple[float, ...], distortion: tuple[float, ...]
) -> np.ndarray:
    """Rays ``(N, 3)`` of the fine pixels."""
    step = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    u, v = ((np.arange(size)[:, None] + step).ravel() for size in (width, height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    K = np.array([[camera[0], 0, camera[2]], [0, camera[1], camera[3]], [0, 0, 1]])
    undistort = cv2.fisheye.undistortPoints if model == "fisheye" else cv2.undistortPoints
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-8)
    flat = undistort(pixels, K, np.array(distortion), criteria=criteria)
    return np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])


@functools.cache
def texture(board: Board) -> np.ndarray:
    columns, rows = board.columns + 1, board.rows + 1
    if board.pattern == "charuco":
        inside = board.charuco().generateImage((columns * _TEXEL_PX, rows * _TEXEL_PX))
    else:
        row, column = np.mgrid[:rows, :columns]
        inside = np.kron(255 * ((row + column) % 2).astype(np.uint8), np.ones((_TEXEL_PX,) * 2, np.uint8))
    return np.pad(inside, _MARGIN * _TEXEL_PX, constant_values=255)


def spread(count: int, steepest_deg: float, seed: int = 0, nearest_m: float = 0.42) -> list[tuple]:
    """Tilts and places of the board over the whole image."""
    random = np.random.default_rng(seed)
    views = []
    for k in range(count):
        turn = 2 * np.pi * k / count
        tilt = steepest_deg * (0.4 + 0.6 * random.random())
        z = nearest_m + 0.15 * random.random()
        x, y = 0.26 * z * np.cos(2.4 * k), 0.16 * z * np.sin(2.4 * k)
        views.append(((tilt * np.cos(turn), tilt * np.sin(turn), random.uniform(-20, 20)), (x, y, z)))
    return views


@pytest.fixture
def write_views(tmp_path: Path) -> Callable[..., Path]:
    """Writes pictures of a studio's views to a folder, with a little noise."""

    def write(studio: Studio, views: list[tuple], name: str = "board") -> Path:
        folder = tmp_path / name
        folder.mkdir()
        random = np.random.default_rng(1)
        for k, (tilt, place) in enumerate(views):
            picture = studio.picture(tilt, place) + random.normal(0, 2, (studio.height, studio.width))
            cv2.imwrite(str(folder / f"{k:03d}.png"), np.clip(picture, 0, 255).astype(np.uint8))
        return folder

    return write


@pytest.fixture
def make_studio() -> type[Studio]:
    return Studio


@pytest.fixture
def make_views() -> Callable[..., list[tuple]]:
    return spread
