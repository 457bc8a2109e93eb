"""Modulated deformable convolution in plain PyTorch (Dai et al. 2017; Zhu et al. 2019).

All taps of all outputs are read by one bilinear sampling on a map stretched by the kernel size,
and a convolution whose stride is its kernel size then combines them. Meaning and argument order
are torchvision's.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def deform_conv2d(
    input: Tensor,
    offset: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: int | tuple[int, int] = 1,
    padding: int | tuple[int, int] = 0,
    dilation: int | tuple[int, int] = 1,
    mask: Tensor | None = None,
) -> Tensor:
    """Convolve with every tap moved by its own offset and scaled by its own mask value.

    y(p) = sum_k w_k m_k(p) x(p + p_k + dp_k(p))        (Zhu et al. 2019, Eq. 1)

    Samples are bilinear with zeros outside the image. The number of offset groups G follows from
    the channels of `offset`, the number of weight groups from the channels of `weight`.

    Args:
        input: feature map, ``(B, C_in, H, W)``.
        offset: tap offsets in pixels, ``(B, 2 * G * k_h * k_w, H_out, W_out)``, (dy, dx) per tap.
        weight: kernel, ``(C_out, C_in / groups, k_h, k_w)``.
        bias: ``(C_out,)`` or None.
        stride: one value, or (rows, columns); so are `padding` and `dilation`.
        padding: zeros around the image.
        dilation: distance between the resting places of neighbouring taps.
        mask: tap factors, ``(B, G * k_h * k_w, H_out, W_out)``, or None for one.

    Returns:
        ``(B, C_out, H_out, W_out)``.

    Raises:
        ValueError: if the shapes do not fit together.
    """
    stride, padding, dilation = _pair(stride), _pair(padding), _pair(dilation)
    kernel = (weight.shape[-2], weight.shape[-1])
    size = (input.shape[-2], input.shape[-1])
    out_size = tuple(
        (n + 2 * p - d * (k - 1) - 1) // s + 1
        for n, p, d, k, s in zip(size, padding, dilation, kernel, stride)
    )
    offset_groups = _check_shapes(input, offset, weight, mask, out_size)
    batch, channels = input.shape[:2]
    rows = _resting_places(out_size[0], kernel[0], stride[0], padding[0], dilation[0], offset)
    columns = _resting_places(out_size[1], kernel[1], stride[1], padding[1], dilation[1], offset)
    grid = _sampling_grid(offset, rows, columns, size)  # (B * G, H_out * k_h, W_out * k_w, 2)
    grouped = input.reshape(batch * offset_groups, channels // offset_groups, *size).to(grid.dtype)
    sampled = F.grid_sample(grouped, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    if mask is not None:
        sampled = sampled * _stretch(mask, batch * offset_groups, kernel).to(grid.dtype)
    sampled = sampled.reshape(batch, channels, *sampled.shape[-2:]).to(weight.dtype)
    return F.conv2d(sampled, weight, bias, stride=kernel, groups=channels // weight.shape[1])


class DeformableConv2d(nn.Module):
    """Deformable convolution that predicts its own offsets and modulation from its input.

    Three convolutions of the same kernel, stride and padding: offsets in pixels (with bias), modulator
    2 * sigmoid (with bias), and the kernel itself (no bias).
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: int, stride: int, padding: int) -> None:
        super().__init__()
        self.stride = stride
        self.padding = padding
        self.offset = nn.Conv2d(in_channels, 2 * kernel**2, kernel, stride, padding)
        self.modulator = nn.Conv2d(in_channels, kernel**2, kernel, stride, padding)
        self.kernel = nn.Conv2d(in_channels, out_channels, kernel, stride, padding, bias=False)
        self.reset_offsets()

    def reset_offsets(self) -> None:
        """Start as a plain convolution: no offset, and a modulator of 2 * sigmoid(0) = 1."""
        for convolution in (self.offset, self.modulator):
            nn.init.zeros_(convolution.weight)
            assert convolution.bias is not None
            nn.init.zeros_(convolution.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Convolve ``(B, C_in, H, W)`` into ``(B, C_out, H_out, W_out)``."""
        return deform_conv2d(
            features,
            self.offset(features),
            self.kernel.weight,
            stride=self.stride,
            padding=self.padding,
            mask=2 * torch.sigmoid(self.modulator(features)),
        )


def _pair(value: int | tuple[int, int]) -> tuple[int, int]:
    return (value, value) if isinstance(value, int) else (value[0], value[1])


def _check_shapes(
    input: Tensor, offset: Tensor, weight: Tensor, mask: Tensor | None, out_size: tuple[int, ...]
) -> int:
    """Refuse what does not fit, and return the number of offset groups."""
    if input.dim() != 4 or weight.dim() != 4:
        raise ValueError(
            f"input and weight must have four dimensions; got {tuple(input.shape)} and {tuple(weight.shape)}"
        )
    batch, channels = input.shape[:2]
    taps = weight.shape[-2] * weight.shape[-1]
    if channels % weight.shape[1] or weight.shape[0] % (channels // weight.shape[1]):
        raise ValueError(
            f"weight must have shape (C_out, {channels} / groups, k_h, k_w) with groups dividing C_out; "
            f"got {tuple(weight.shape)}"
        )
    if min(out_size) < 1:
        raise ValueError(f"the kernel does not fit: the output would have size {out_size}")
    offset_groups = max(offset.shape[1] // (2 * taps), 1) if offset.dim() == 4 else 1
    wanted = (batch, 2 * offset_groups * taps, *out_size)
    if tuple(offset.shape) != wanted:
        raise ValueError(f"offset must have shape {wanted}; got {tuple(offset.shape)}")
    if channels % offset_groups:
        raise ValueError(f"the {offset_groups} offset groups must divide the {channels} input channels")
    wanted = (batch, offset_groups * taps, *out_size)
    if mask is not None and tuple(mask.shape) != wanted:
        raise ValueError(f"mask must have shape {wanted}; got {tuple(mask.shape)}")
    return offset_groups


def _resting_places(out: int, kernel: int, stride: int, padding: int, dilation: int, like: Tensor) -> Tensor:
    """Where the taps of each output lie along one axis without offsets, in pixels, ``(out, kernel)``."""
    dtype = torch.promote_types(like.dtype, torch.float32)  # half precision cannot count pixels
    first = torch.arange(out, device=like.device, dtype=dtype) * stride - padding
    return first[:, None] + torch.arange(kernel, device=like.device, dtype=dtype) * dilation


def _sampling_grid(offset: Tensor, rows: Tensor, columns: Tensor, size: tuple[int, int]) -> Tensor:
    """Normalised sampling positions, ``(B * G, H_out * k_h, W_out * k_w, 2)``, x first.

    Pixel p of n lies at (2 p + 1) / n - 1: grid_sample's convention without aligned corners, which
    unlike the aligned one holds for a single pixel too.
    """
    (out_h, k_h), (out_w, k_w) = rows.shape, columns.shape
    height, width = size
    moves = offset.reshape(-1, k_h, k_w, 2, out_h, out_w).permute(3, 0, 4, 1, 5, 2)
    dy, dx = moves[0], moves[1]  # (B * G, H_out, k_h, W_out, k_w)
    y = torch.add(((2 * rows + 1) / height - 1)[:, :, None, None], dy, alpha=2 / height)
    x = torch.add(((2 * columns + 1) / width - 1), dx, alpha=2 / width)
    return torch.stack((x, y), dim=-1).reshape(-1, out_h * k_h, out_w * k_w, 2)


def _stretch(mask: Tensor, maps: int, kernel: tuple[int, int]) -> Tensor:
    """Lay ``(B, G * k_h * k_w, H_out, W_out)`` out as ``(B * G, 1, H_out * k_h, W_out * k_w)``."""
    k_h, k_w = kernel
    out_h, out_w = mask.shape[-2:]
    tapwise = mask.reshape(maps, k_h, k_w, out_h, out_w).permute(0, 3, 1, 4, 2)
    return tapwise.reshape(maps, 1, out_h * k_h, out_w * k_w)
