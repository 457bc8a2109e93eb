"""Modulated deformable convolution in plain PyTorch (Dai et al. 2017; Zhu et al. 2019).

One bilinear sampling reads all taps of all outputs in the order of the kernel's weights, and one
matrix product combines them. Offsets and masks have the meaning and order of torchvision's.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Sampled values processed at once on a CPU, so that they stay in its caches: forward and backward of the
# paper's largest layer (7 x 7 on 32 channels, 208 x 64, batch 4) take 1.6 s so, 6 s in one piece.
_CPU_CHUNK = 2**20


def deform_conv2d(
    input: Tensor, offset: Tensor, weight: Tensor, mask: Tensor, stride: int, padding: int
) -> Tensor:
    """Convolve with every tap moved by its own offset and scaled by its own mask value.

    y(p) = sum_k w_k m_k(p) x(p + p_k + dp_k(p))        (Zhu et al. 2019, Eq. 1)

    Samples are bilinear with zeros outside the image.

    Args:
        input: feature map, ``(B, C_in, H, W)``.
        offset: tap offsets in pixels, ``(B, 2 * k * k, H_out, W_out)``, (dy, dx) per tap.
        weight: kernel, ``(C_out, C_in, k, k)``.
        mask: tap factors, ``(B, k * k, H_out, W_out)``.
        stride: of rows and columns.
        padding: zeros around the image.

    Returns:
        ``(B, C_out, H_out, W_out)``.
    """
    batch, channels, *size = input.shape
    out_h, out_w = offset.shape[2:]
    kernel = weight.shape[-1]
    taps = kernel**2
    rows, columns = (
        _resting_places(out, kernel, stride, padding, offset) for out in (out_h, out_w)
    )
    grid = _sampling_grid(offset, rows, columns, (size[0], size[1]))
    maps, factors = input.to(grid.dtype), mask.to(grid.dtype).reshape(batch, 1, taps, -1)
    images, places = batch, out_h * out_w
    if input.device.type == "cpu" and not torch.onnx.is_in_onnx_export():  # a graph has one piece
        places = max(1, min(places, _CPU_CHUNK // (channels * taps)))
        images = max(1, min(batch, _CPU_CHUNK // (channels * taps * places)))
    split = [torch.split(tensor, images) for tensor in (maps, grid, factors)]
    chunks = [_sample_and_combine(weight, places, *parts) for parts in zip(*split)]
    return _join(chunks, dim=0).view(batch, weight.shape[0], out_h, out_w)


class DeformableConv2d(nn.Module):
    """Deformable convolution that predicts its own offsets and modulation from its input.

    Three convolutions of the same kernel, stride and padding: offsets in pixels (with bias), modulator
    2 * sigmoid (with bias), and the kernel itself (no bias).
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel: int, stride: int, padding: int
    ) -> None:
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
            2 * torch.sigmoid(self.modulator(features)),
            self.stride,
            self.padding,
        )


def _resting_places(out: int, kernel: int, stride: int, padding: int, like: Tensor) -> Tensor:
    """Positions of the taps of each output along one axis at zero offset, in pixels, ``(out, kernel)``."""
    dtype = torch.promote_types(
        like.dtype, torch.float32
    )  # half precision cannot represent pixel indices
    first = torch.arange(out, device=like.device, dtype=dtype) * stride - padding
    return first[:, None] + torch.arange(kernel, device=like.device, dtype=dtype)


def _sampling_grid(offset: Tensor, rows: Tensor, columns: Tensor, size: tuple[int, int]) -> Tensor:
    """Normalised sampling positions, ``(B, k * k, H_out * W_out, 2)``, x first.

    Pixel p of n lies at (2 p + 1) / n - 1: grid_sample's convention without aligned corners, which
    unlike the aligned one holds for a single pixel too.
    """
    (out_h, k_h), (out_w, k_w) = rows.shape, columns.shape
    height, width = size
    moves = offset.reshape(-1, k_h, k_w, 2, out_h, out_w)
    rest_y = ((2 * rows.T + 1) / height - 1)[:, None, :, None]
    rest_x = ((2 * columns.T + 1) / width - 1)[None, :, None, :]
    y = torch.add(rest_y, moves[:, :, :, 0], alpha=2 / height)  # (B, k, k, H_out, W_out)
    x = torch.add(rest_x, moves[:, :, :, 1], alpha=2 / width)
    return torch.stack((x, y), dim=-1).view(-1, k_h * k_w, out_h * out_w, 2)


def _sample_and_combine(
    weight: Tensor, places: int, maps: Tensor, grid: Tensor, factors: Tensor
) -> Tensor:
    """Sample the taps of some images, `places` outputs at a time, and multiply them by the kernel.

    `split` rather than slices: the gradient of n slices is n full-size sums.

    Args:
        weight: kernel, ``(C_out, C_in, k, k)``.
        places: outputs handled at once.
        maps: inputs, ``(b, C_in, H, W)``.
        grid: sampling positions, ``(b, taps, H_out * W_out, 2)``.
        factors: tap factors, ``(b, 1, taps, H_out * W_out)``.

    Returns:
        ``(b, C_out, H_out * W_out)``.
    """
    pieces = []
    for positions, scale in zip(
        torch.split(grid, places, dim=2), torch.split(factors, places, dim=3)
    ):
        sampled = F.grid_sample(
            maps, positions, mode="bilinear", padding_mode="zeros", align_corners=False
        )
        columns = (sampled * scale).to(weight.dtype)
        # a slice, so that torch folds no batch into the product: gradients keep their rounding
        columns = columns.view(-1, 1, weight[0].numel(), columns.shape[-1])
        pieces.append(torch.matmul(weight.flatten(1), columns[:, 0]))
    return _join(pieces, dim=-1)


def _join(pieces: list[Tensor], dim: int) -> Tensor:
    return pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim)
