"""SE(3) on tensors: the pose network's six-vector as a transform, and transforms of points."""

from __future__ import annotations

import torch
from torch import Tensor


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


def transform_points(T_a_b: Tensor, points_b: Tensor) -> Tensor:
    """Points ``(B, 3, P)`` in b moved to a by ``T_a_b`` ``(B, 4, 4)``."""
    return T_a_b[:, :3, :3] @ points_b + T_a_b[:, :3, 3:]
