"""The pinhole camera, and its matrix under resize, crop and flip.

Pixel (0, 0) is the centre of the top-left pixel, so a resize by s moves the principal point as
``c' = (c + 0.5) s - 0.5``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.common.readers.pinhole import Pinhole
from erfsfm.config import Fidelity


@dataclass(frozen=True)
class Camera(Pinhole):
    """Size in pixels and intrinsics of one image."""

    @property
    def K(self) -> NDArray[np.float32]:
        """The camera matrix ``(3, 3)``, pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float32)

    def resized(self, width: int, height: int, fidelity: Fidelity = "default") -> Self:
        """The camera of the resized image: ``c' = (c + 0.5) s - 0.5`` (the paper's code has ``c s``)."""
        if fidelity == "default":
            return super().resized(width, height)
        return replace(self.multiplied(width / self.width, height / self.height), width=width, height=height)

    def multiplied(self, x: float, y: float) -> Self:
        """The rows of the camera matrix times factors, as the paper's code enlarges images; the size stays."""
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of the window whose top-left pixel is ``(left, top)``."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def flipped(self, fidelity: Fidelity = "default") -> Camera:
        """The camera of the mirrored image: ``cx' = W - 1 - cx`` (the paper's code has ``W - cx``)."""
        mirror = self.width if fidelity == "paper" else self.width - 1
        return replace(self, cx=mirror - self.cx)


def scale_intrinsics(K: Tensor, size: tuple[int, int], full: tuple[int, int], fidelity: Fidelity) -> Tensor:
    """Camera matrices of an image pyramid level.

    Args:
        K: ``(B, 3, 3)`` at the full resolution, pixels.
        size: ``(height, width)`` of the level.
        full: ``(height, width)`` of the full resolution.
        fidelity: ``paper`` divides both rows by the height ratio and moves no half pixel, as the
            reference does; ``default`` is exact for each axis.

    Returns:
        ``(B, 3, 3)`` at the level.
    """
    scaled = K.clone()
    if fidelity == "paper":
        scaled[:, :2] = K[:, :2] * (size[0] / full[0])
        return scaled
    sy, sx = size[0] / full[0], size[1] / full[1]
    scaled[:, 0] = K[:, 0] * sx
    scaled[:, 1] = K[:, 1] * sy
    scaled[:, 0, 2] = (K[:, 0, 2] + 0.5) * sx - 0.5
    scaled[:, 1, 2] = (K[:, 1, 2] + 0.5) * sy - 0.5
    return scaled


def pixel_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Homogeneous pixel coordinates ``(3, H * W)``: rows u, v, 1."""
    v, u = torch.meshgrid(
        torch.arange(height, device=like.device, dtype=like.dtype),
        torch.arange(width, device=like.device, dtype=like.dtype),
        indexing="ij",
    )
    return torch.stack([u.flatten(), v.flatten(), torch.ones_like(u).flatten()])


def inverse_intrinsics(K: Tensor) -> Tensor:
    """``K^-1`` ``(B, 3, 3)`` of camera matrices without skew, in closed form."""
    inverse = torch.zeros_like(K)
    inverse[:, 0, 0] = 1 / K[:, 0, 0]
    inverse[:, 1, 1] = 1 / K[:, 1, 1]
    inverse[:, 0, 2] = -K[:, 0, 2] / K[:, 0, 0]
    inverse[:, 1, 2] = -K[:, 1, 2] / K[:, 1, 1]
    inverse[:, 2, 2] = 1
    return inverse


def backproject(depth: Tensor, K: Tensor) -> Tensor:
    """Lift each pixel to its 3-D point in the camera frame.

    X(p) = D(p) K^-1 [u, v, 1]^T        (Zhou et al. 2017, Eq. 2, right factor)

    Args:
        depth: z-depth, ``(B, 1, H, W)``, positive.
        K: intrinsics at this resolution, ``(B, 3, 3)``.

    Returns:
        Points in the camera frame, in the depth's unit, ``(B, 3, H * W)``.
    """
    batch, _, height, width = depth.shape
    rays = inverse_intrinsics(K) @ pixel_grid(height, width, depth)  # (B, 3, H*W)
    return rays * depth.reshape(batch, 1, height * width)
