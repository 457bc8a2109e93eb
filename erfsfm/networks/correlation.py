"""Where the pixels of one feature map are in another."""

from __future__ import annotations

import torch
from torch import Tensor


def expected_place(target: Tensor, source: Tensor, places: Tensor, sharpness: Tensor) -> tuple[Tensor, Tensor]:
    """Mean place of each target cell over all cells of the source, weighted by a softmax of their likeness.

    Args:
        target: normalised features ``(B, C, h, w)``.
        source: the same shape.
        places: of the source's cells, ``(h * w, 2)``.
        sharpness: factor on the cosine before the softmax.

    Returns:
        ``(B, h * w, 2)``, and the largest probability ``(B, h * w, 1)``.
    """
    likeness = target.flatten(2).transpose(1, 2) @ source.flatten(2)
    probability = (sharpness * likeness).softmax(dim=-1)
    return probability @ places, probability.amax(dim=-1, keepdim=True)


def local_correlation(target: Tensor, source: Tensor, reach: tuple[int, int]) -> Tensor:
    """Scalar product of each target cell with the source's cells around its place.

    Args:
        target: ``(B, C, h, w)``.
        source: padded by ``reach`` on every side, ``(B, C, h + 2 * reach[0], w + 2 * reach[1])``.
        reach: rows and columns on either side.

    Returns:
        ``(B, (2 * reach[0] + 1) * (2 * reach[1] + 1), h, w)``, row by row.
    """
    B, C, h, w = target.shape
    m, n = 2 * reach[0] + 1, 2 * reach[1] + 1
    device = target.device
    rows = (torch.arange(m, device=device)[:, None] + torch.arange(h, device=device)).flatten()
    lines = source.permute(0, 2, 1, 3)[:, rows].reshape(B, m, h, C, w + n - 1)
    # each row with each row nearby as one product of matrices, of which only the diagonals are wanted
    products = (target.permute(0, 2, 3, 1).unsqueeze(1) @ lines).flatten(-2)
    columns = torch.arange(n, device=device)[:, None] + torch.arange(w, device=device) * (w + n)
    diagonals = products.index_select(-1, columns.flatten()).reshape(B, m, h, n, w)
    return diagonals.permute(0, 1, 3, 2, 4).reshape(B, m * n, h, w)


def offsets(reach: tuple[int, int], cell: tuple[float, float], device: torch.device) -> Tensor:
    """Steps (x, y) of the channels of `local_correlation`, ``(n, 2)``, for cells of some height and width."""
    y = torch.arange(-reach[0], reach[0] + 1, device=device) * cell[0]
    x = torch.arange(-reach[1], reach[1] + 1, device=device) * cell[1]
    return torch.stack([x.repeat(len(y)), y.repeat_interleave(len(x))], dim=-1)
