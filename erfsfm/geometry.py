"""The pinhole camera and its matrix under resize, crop and flip; SE(3) on tensors; the inverse warp (Zhou et al. 2017).

Pixel (0, 0) is the centre of the top-left pixel, so a resize by s moves the principal point as
``c' = (c + 0.5) s - 0.5``. The inverse warp is a source image seen from the target camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.common.readers.camera_file import Pinhole
from erfsfm.config import Fidelity

MINIMUM_Z = 1e-3


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
        return replace(
            self.multiplied(width / self.width, height / self.height), width=width, height=height
        )

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


def scale_intrinsics(
    K: Tensor, size: tuple[int, int], full: tuple[int, int], fidelity: Fidelity
) -> Tensor:
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
        scaled[:, :2] *= size[0] / full[0]
        return scaled
    for row, ratio in enumerate((size[1] / full[1], size[0] / full[0])):
        scaled[:, row] *= ratio
        scaled[:, row, 2] += 0.5 * ratio - 0.5
    return scaled


def pixel_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Homogeneous pixel coordinates ``(3, H * W)``: rows u, v, 1."""
    v, u = torch.meshgrid(
        torch.arange(height, device=like.device, dtype=like.dtype),
        torch.arange(width, device=like.device, dtype=like.dtype),
        indexing="ij",
    )
    return torch.stack([u.flatten(), v.flatten(), torch.ones_like(u).flatten()])


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
    K_inverse, _ = torch.linalg.inv_ex(K)  # a check would wait for a GPU
    rays = K_inverse @ pixel_grid(height, width, depth)  # (B, 3, H*W)
    return rays * depth.reshape(batch, 1, height * width)


def euler_to_rotation(euler: Tensor) -> Tensor:
    """Rotation matrices of intrinsic XYZ Euler angles, ``R = Rx Ry Rz``.

    Args:
        euler: ``(..., 3)`` radians.

    Returns:
        ``(..., 3, 3)``.
    """
    cx, cy, cz = euler.cos().unbind(-1)
    sx, sy, sz = euler.sin().unbind(-1)
    rows = [
        cy * cz,
        -cy * sz,
        sy,
        cx * sz + sx * sy * cz,
        cx * cz - sx * sy * sz,
        -sx * cy,
        sx * sz - cx * sy * cz,
        sx * cz + cx * sy * sz,
        cx * cy,
    ]
    return torch.stack(rows, dim=-1).reshape(*euler.shape[:-1], 3, 3)


def pose_vector_to_matrix(pose_vec_trans_euler: Tensor) -> Tensor:
    """``T_source_target`` from the network's six-vector: translation first, then XYZ Euler.

    Args:
        pose_vec_trans_euler: ``(..., 6)``.

    Returns:
        ``(..., 4, 4)``.
    """
    translation, euler = pose_vec_trans_euler[..., :3], pose_vec_trans_euler[..., 3:]
    top = torch.cat([euler_to_rotation(euler), translation.unsqueeze(-1)], dim=-1)  # (..., 3, 4)
    none = torch.zeros_like(top[..., :1, :])
    return torch.cat([top, torch.cat([none[..., :3], none[..., 3:] + 1], dim=-1)], dim=-2)


def project_into_source(depth: Tensor, T_source_target: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Project the target's points into the source camera.

    p_s ~ K T_source_target D(p_t) K^-1 p_t        (Zhou et al. 2017, Eq. 2)

    Args:
        depth: target z-depth ``(B, 1, H, W)``.
        T_source_target: ``(B, 4, 4)``.
        K: intrinsics shared by both images, ``(B, 3, 3)``.

    Returns:
        Where each pixel lands, ``(B, H, W, 2)`` in ``grid_sample`` coordinates (align_corners=True), and whether that
        is in front of the source camera and inside its image, ``(B, 1, H, W)``.
    """
    batch, _, height, width = depth.shape
    points_source = (
        T_source_target[:, :3, :3] @ backproject(depth, K) + T_source_target[:, :3, 3:]
    )  # (B, 3, H*W)
    z = points_source[:, 2:]
    pixels = (K @ points_source)[:, :2] / z.clamp(min=MINIMUM_Z)  # (B, 2, H*W)
    extents = max(width - 1, 1), max(height - 1, 1)
    axes = [
        2 * pixels[:, k : k + 1] / extent - 1 for k, extent in enumerate(extents)
    ]  # (B, 1, H*W) each
    inside = z > MINIMUM_Z
    for axis, extent in zip(axes, extents):
        # half a thousandth of a pixel of slack: round-off must not cut the border off an identity warp
        inside = inside & (axis.abs() <= 1 + 1e-3 / extent)
    grid = torch.cat(axes, dim=1).reshape(batch, 2, height, width).permute(0, 2, 3, 1)
    return grid, inside.reshape(batch, 1, height, width)


def sample(image: Tensor, grid: Tensor) -> Tensor:
    """Bilinear look-up of ``image`` ``(B, C, H, W)`` at ``(B, H, W, 2)``; the border is repeated outside."""
    # far-outside coordinates would overflow the integer conversion inside grid_sample
    grid = torch.nan_to_num(grid, nan=2.0).clamp(-2, 2)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
