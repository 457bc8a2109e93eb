"""Camera motion from correspondences by weighted least squares, each point's inverse depth being known roughly.

Tensors and plain operators alone, so that networks can be trained through it and exported.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from erfsfm.geometry.transforms import euler_to_rotation

# An image does not show its camera: viewing rays are those of KITTI's, in image widths and heights.
FOCAL = (0.58, 1.92)
CENTRE = (0.495, 0.48)
NOISE = 0.005  # unit of sigmas on the image plane: 1.2 pixels of 416
DAMPING = 1e-4  # keeps the motion of a blank image finite
LARGEST_STEP = 0.3  # radians, or units of length, in one iteration
NEAREST = 0.1  # of a point's depth after the motion over that before


def cell_rays(rows: int, columns: int, device: torch.device) -> Tensor:
    """Viewing rays ``(rows * columns, 3)`` of the centres of the cells that an image is divided into, with z = 1.

    Args:
        rows: of a feature map.
        columns: of a feature map.
        device: of the rays.
    """
    y = ((torch.arange(rows, device=device) + 0.5) * (1 / rows) - CENTRE[1]) / FOCAL[1]
    x = ((torch.arange(columns, device=device) + 0.5) * (1 / columns) - CENTRE[0]) / FOCAL[0]
    x, y = x.repeat(rows), y.repeat_interleave(columns)
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def project(rays: Tensor, inverse_depth: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points of a target seen from its source.

    Args:
        rays: ``(P, 3)``.
        inverse_depth: ``(B, P)``.
        R: of ``T_source_target``, ``(B, 3, 3)``.
        t: of ``T_source_target``, ``(B, 3)``.

    Returns:
        Rotated rays ``(B, P, 3)``, positions on the source's image plane ``(B, P, 2)``, and ``(B, P)`` one over the
        ratio of the depths.
    """
    turned = rays @ R.transpose(-1, -2)
    x, y, z = (turned + inverse_depth.unsqueeze(-1) * t.unsqueeze(-2)).unbind(-1)
    nearer = 1 / z.clamp(min=NEAREST)
    return turned, torch.stack([x * nearer, y * nearer], dim=-1), nearer


def align(
    seen: Tensor,
    information: Tensor,
    rays: Tensor,
    inverse_depth: tuple[Tensor, Tensor],
    motion: tuple[Tensor, Tensor],
    outliers: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """Motion that carries points to where they were seen, by Gauss and Newton.

    What an error of the inverse depth would explain is discounted (the Schur complement of each point's own
    inverse depth), so that a wrong depth of something near does not turn the camera.

    Args:
        seen: of each point on the source's image plane, ``(B, P, 2)``.
        information: inverse variances of both coordinates, ``(B, P, 2)``, in ``NOISE ** -2``.
        rays: of the points, ``(P, 3)``.
        inverse_depth: and its sigma, each ``(B, P)``.
        motion: rotation ``(B, 3, 3)`` and translation ``(B, 3)`` of ``T_source_target`` to start from.
        outliers: for each linearisation, the error in ``NOISE`` at which a point counts half (Cauchy's weights).
    """
    (R, t), (value, sigma) = motion, inverse_depth
    identity = torch.eye(6, device=seen.device)
    for outlier in outliers:
        wx, wy = information.unbind(-1)
        turned, at, nearer = project(rays, value, R, t)
        (x, y), (a, b, c) = at.unbind(-1), turned.unbind(-1)
        shift, none = nearer * value, torch.zeros_like(x)
        J_x = torch.stack([-nearer * x * b, nearer * (c + x * a), -nearer * b, shift, none, -x * shift], dim=-1)
        J_y = torch.stack([-nearer * (c + y * b), nearer * y * a, nearer * a, none, shift, -y * shift], dim=-1)
        by_depth_x = nearer * (t[:, None, 0] - x * t[:, None, 2])
        by_depth_y = nearer * (t[:, None, 1] - y * t[:, None, 2])
        r_x, r_y = (seen - at).unbind(-1)
        prior = (NOISE / sigma) ** 2
        error = wx * r_x**2 + wy * r_y**2
        error = error - (wx * by_depth_x * r_x + wy * by_depth_y * r_y) ** 2 / (
            prior + wx * by_depth_x**2 + wy * by_depth_y**2
        )
        believed = 1 / (1 + error.clamp(min=0) / (outlier * NOISE) ** 2)
        wx, wy = believed * wx, believed * wy
        depth_information = prior + wx * by_depth_x**2 + wy * by_depth_y**2
        mixed = J_x * (wx * by_depth_x).unsqueeze(-1) + J_y * (wy * by_depth_y).unsqueeze(-1)
        r_mixed = wx * by_depth_x * r_x + wy * by_depth_y * r_y
        J = torch.cat([J_x, J_y, mixed], dim=-2)  # (B, 3 P, 6)
        weights = torch.cat([wx, wy, -1 / depth_information], dim=-1).unsqueeze(-1) / len(rays)
        weighted = (J * weights).transpose(-1, -2)
        right = weighted @ torch.cat([r_x, r_y, r_mixed], dim=-1).unsqueeze(-1)
        step = solve(weighted @ J + DAMPING * identity, right[..., 0]).clamp(-LARGEST_STEP, LARGEST_STEP)
        R, t = euler_to_rotation(step[..., :3]) @ R, t + step[..., 3:]
    return R, t


def solve(A: Tensor, b: Tensor) -> Tensor:
    """Solution of ``A x = b`` for symmetric positive definite ``A`` ``(B, n, n)``, by Gauss and Jordan."""
    n = A.shape[-1]
    system = torch.cat([A, b.unsqueeze(-1)], dim=-1)
    unit = torch.eye(n, device=A.device)
    for k in range(n):
        row = system[..., k : k + 1, :] / system[..., k : k + 1, k : k + 1]
        system = system - (system[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return system[..., -1]


def rotation_to_euler(R: Tensor) -> Tensor:
    """Intrinsic XYZ Euler angles ``(..., 3)`` of rotations ``R = Rx Ry Rz`` of less than a right angle."""
    x = torch.atan2(-R[..., 1, 2], R[..., 2, 2])
    y = torch.asin(R[..., 0, 2].clamp(-0.999, 0.999))
    z = torch.atan2(-R[..., 0, 1], R[..., 0, 0])
    return torch.stack([x, y, z], dim=-1)
