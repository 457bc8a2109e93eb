"""Deformable convolution on a CPU with its sampling compiled by Numba: an optional fast path.

A tap reads four pixels with all their channels, which are contiguous here; `grid_sample` reads one channel
after the other. Only the arguments are kept for the backward pass: sampling the image again costs less than
storing every sample. `erfsfm.networks.deformable` holds the reference path in PyTorch and chooses between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

# Sampled values processed at once, so that they stay in the caches.
_CHUNK = 2**19

Array = NDArray[np.floating[Any]]


def deform_conv2d(input: Tensor, offset: Tensor, mask: Tensor, weight: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Convolve with one group of offsets and one of weights; differentiable once. Nothing is checked.

    y(p) = sum_k w_k m_k(p) x(p + p_k + dp_k(p))        (Zhu et al. 2019, Eq. 1)

    Args:
        input: feature map, ``(B, C_in, H, W)``, float32 or float64 on a CPU, as all the others.
        offset: tap offsets in pixels, ``(B, 2 * k_h * k_w, H_out, W_out)``, (dy, dx) per tap.
        mask: tap factors, ``(B, k_h * k_w, H_out, W_out)``.
        weight: kernel, ``(C_out, C_in, k_h, k_w)``.
        rows: positions of the taps of each output row at zero offset, in pixels, ``(H_out, k_h)``.
        columns: the same along the other axis, ``(W_out, k_w)``.

    Returns:
        ``(B, C_out, H_out, W_out)``.
    """
    output: Tensor = _DeformConv2d.apply(input, offset, mask, weight, rows, columns)
    return output


class _DeformConv2d(torch.autograd.Function):
    """Sampling by the kernels below, an image a thread; products by PyTorch."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, input: Tensor, offset: Tensor, mask: Tensor, weight: Tensor, rows: Tensor, columns: Tensor
    ) -> Tensor:
        ctx.save_for_backward(input, offset, mask, weight, rows, columns)
        batch, channels = input.shape[:2]
        kernel = _taps_before_channels(weight)
        arguments = _arrays(input, offset, mask, rows, columns)
        places, chunk = offset[0, 0].numel(), _places_at_once(input, mask)
        output = input.new_empty(batch, len(weight), *offset.shape[2:])
        with _pool(batch) as pool:
            for first in range(0, places, chunk):
                count = min(chunk, places - first)
                samples = input.new_empty(batch, count, mask.shape[1], channels)
                list(pool.map(_read, *arguments, repeat(first), samples.numpy()))
                product = samples.view(batch * count, -1) @ kernel.T
                output.flatten(2)[..., first : first + count] = product.view(batch, count, -1).transpose(1, 2)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        input, offset, mask, weight, rows, columns = ctx.saved_tensors
        batch, channels, height, width = input.shape
        kernel = _taps_before_channels(weight)
        arguments = _arrays(input, offset, mask, rows, columns)
        places, chunk = offset[0, 0].numel(), _places_at_once(input, mask)
        upstream = gradient.flatten(2).transpose(1, 2).contiguous()  # (B, H_out * W_out, C_out)
        of_input = input.new_zeros(batch, height, width, channels)
        of_offset, of_mask = (tensor.new_zeros(batch, tensor.shape[1], places) for tensor in (offset, mask))
        of_kernel = torch.zeros_like(kernel)
        results = [tensor.numpy() for tensor in (of_input, of_offset, of_mask)]
        with _pool(batch) as pool:
            for first in range(0, places, chunk):
                part = upstream[:, first : first + chunk].flatten(0, 1)  # (B * count, C_out)
                of_samples = (part @ kernel).view(batch, -1, mask.shape[1], channels)
                samples = torch.empty_like(of_samples)
                list(pool.map(_spread, *arguments, repeat(first), of_samples.numpy(), samples.numpy(), zip(*results)))
                of_kernel.addmm_(part.T, samples.view(len(part), -1))
        of_weight = of_kernel.view(-1, *weight.shape[2:], channels).permute(0, 3, 1, 2)
        return of_input.permute(0, 3, 1, 2), of_offset.view_as(offset), of_mask.view_as(mask), of_weight, None, None


def _taps_before_channels(weight: Tensor) -> Tensor:
    """The kernel as a matrix in the order of the samples, ``(C_out, k_h * k_w * C_in)``."""
    return weight.permute(0, 2, 3, 1).flatten(1)


def _arrays(input: Tensor, offset: Tensor, mask: Tensor, rows: Tensor, columns: Tensor) -> tuple[Any, ...]:
    """The first arguments of `_read` and `_spread`, image by image."""
    images = input.detach().permute(0, 2, 3, 1).contiguous().numpy()
    offsets, factors = (tensor.detach().flatten(2).contiguous().numpy() for tensor in (offset, mask))
    return images, repeat((rows.numpy(), columns.numpy())), offsets, factors


def _places_at_once(input: Tensor, mask: Tensor) -> int:
    return max(1, _CHUNK // (input.shape[0] * input.shape[1] * mask.shape[1]))


def _pool(batch: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(batch, torch.get_num_threads()))


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile on first use and keep the result on disk, where Numba finds a folder that it may write.

    Sums may be reordered, so that they vectorise; NaN stays NaN.
    """
    options: dict[str, Any] = {"nogil": True, "fastmath": {"reassoc", "contract", "nsz"}}
    try:
        compiled: Callable[..., Any] = njit(cache=True, **options)(function)
    except RuntimeError:
        compiled = njit(**options)(function)
    return compiled


@_compiled
def _neighbours(place: float, size: int) -> tuple[int, int, float, float, float, float]:
    """The two pixels around a place on one axis: their indices, weights, and derivatives of the weights.

    A pixel outside the image has the index of the one inside, no weight and no derivative.
    """
    low = math.floor(place)
    fraction = place - low
    low_inside = 1.0 if low >= 0 else 0.0
    high_inside = 1.0 if low + 1 < size else 0.0
    return (
        max(int(low), 0),
        min(int(low) + 1, size - 1),
        low_inside * (1 - fraction),
        high_inside * fraction,
        -low_inside,
        high_inside,
    )


@_compiled
def _read(image: Array, rest: tuple[Array, Array], offset: Array, mask: Array, first: int, samples: Array) -> None:
    """Sample the taps of some outputs of one image.

    Args:
        image: ``(H, W, C)``.
        rest: rows ``(H_out, k_h)`` and columns ``(W_out, k_w)`` of the taps without offsets, pixels.
        offset: ``(2 * k_h * k_w, H_out * W_out)``.
        mask: ``(k_h * k_w, H_out * W_out)``.
        first: index of the first output.
        samples: receives values times factors, ``(outputs, k_h * k_w, C)``.
    """
    height, width, channels = image.shape
    rows, columns = rest
    out_w, k_w = columns.shape
    as_image = image.dtype.type  # positions are doubles; in the loop over channels these would halve the speed
    for n in range(samples.shape[0]):
        i, j = divmod(first + n, out_w)
        for k in range(mask.shape[0]):
            factor = mask[k, first + n]
            y = rows[i, k // k_w] + offset[2 * k, first + n]
            x = columns[j, k % k_w] + offset[2 * k + 1, first + n]
            if not (-1 < y < height and -1 < x < width):
                samples[n, k] = 0 * factor  # also where it is not a number
                continue
            top, bottom, y0, y1, _, _ = _neighbours(y, height)
            left, right, x0, x1, _, _ = _neighbours(x, width)
            w00, w01 = as_image(factor * y0 * x0), as_image(factor * y0 * x1)
            w10, w11 = as_image(factor * y1 * x0), as_image(factor * y1 * x1)
            for c in range(channels):
                upper = w00 * image[top, left, c] + w01 * image[top, right, c]
                lower = w10 * image[bottom, left, c] + w11 * image[bottom, right, c]
                samples[n, k, c] = upper + lower


@_compiled
def _spread(
    image: Array,
    rest: tuple[Array, Array],
    offset: Array,
    mask: Array,
    first: int,
    of_samples: Array,
    samples: Array,
    gradients: tuple[Array, Array, Array],
) -> None:
    """Sample as `_read` does, and propagate the gradient of the samples to image, offset and mask.

    Args:
        image, rest, offset, mask, first: as of `_read`.
        of_samples: gradient, ``(outputs, k_h * k_w, C)``.
        samples: receives what `_read` gives.
        gradients: that of ``image``, added to; receives those of ``offset`` and ``mask``.
    """
    of_image, of_offset, of_mask = gradients
    height, width, channels = image.shape
    rows, columns = rest
    out_w, k_w = columns.shape
    as_image = image.dtype.type
    for n in range(samples.shape[0]):
        i, j = divmod(first + n, out_w)
        for k in range(mask.shape[0]):
            factor = mask[k, first + n]
            y = rows[i, k // k_w] + offset[2 * k, first + n]
            x = columns[j, k % k_w] + offset[2 * k + 1, first + n]
            if not (-1 < y < height and -1 < x < width):
                samples[n, k] = 0 * factor
                continue
            top, bottom, y0, y1, dy0, dy1 = _neighbours(y, height)
            left, right, x0, x1, dx0, dx1 = _neighbours(x, width)
            w00, w01 = as_image(factor * y0 * x0), as_image(factor * y0 * x1)
            w10, w11 = as_image(factor * y1 * x0), as_image(factor * y1 * x1)
            g00 = g01 = g10 = g11 = as_image(0)
            for c in range(channels):
                x00, x01 = image[top, left, c], image[top, right, c]
                x10, x11 = image[bottom, left, c], image[bottom, right, c]
                g = of_samples[n, k, c]
                samples[n, k, c] = w00 * x00 + w01 * x01 + w10 * x10 + w11 * x11
                g00, g01, g10, g11 = g00 + g * x00, g01 + g * x01, g10 + g * x10, g11 + g * x11
            of_mask[k, first + n] = y0 * (x0 * g00 + x1 * g01) + y1 * (x0 * g10 + x1 * g11)
            of_offset[2 * k, first + n] = factor * (dy0 * (x0 * g00 + x1 * g01) + dy1 * (x0 * g10 + x1 * g11))
            of_offset[2 * k + 1, first + n] = factor * (y0 * (dx0 * g00 + dx1 * g01) + y1 * (dx0 * g10 + dx1 * g11))
            # one loop for each corner: corners may be the same pixel, and four sums in one loop would not vectorise
            for c in range(channels):
                of_image[top, left, c] += w00 * of_samples[n, k, c]
            for c in range(channels):
                of_image[top, right, c] += w01 * of_samples[n, k, c]
            for c in range(channels):
                of_image[bottom, left, c] += w10 * of_samples[n, k, c]
            for c in range(channels):
                of_image[bottom, right, c] += w11 * of_samples[n, k, c]
