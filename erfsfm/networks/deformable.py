"""Modulated deformable convolution in plain PyTorch (Dai et al. 2017; Zhu et al. 2019).

One bilinear sampling reads all taps of all outputs in the order of the kernel's weights, and one
matrix product combines them. Meaning and argument order are torchvision's.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Sampled values processed at once on a CPU, so that they stay in its caches: forward and backward of the
# paper's largest layer (7 x 7 on 32 channels, 208 x 64, batch 4) take 1.6 s so, 6 s in one piece.
_CPU_CHUNK = 2**20

_LARGE = 2**20  # sampled values of a layer


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
        dilation: distance between neighbouring taps at zero offset.
        mask: tap factors, ``(B, G * k_h * k_w, H_out, W_out)``, or None for one.

    Returns:
        ``(B, C_out, H_out, W_out)``.

    Raises:
        ValueError: if the shapes do not fit together.
    """
    stride, padding, dilation = _pair(stride), _pair(padding), _pair(dilation)
    out_h, out_w = _check_shapes(input, offset, weight, mask, stride, padding, dilation)
    rows = _resting_places(out_h, weight.shape[2], stride[0], padding[0], dilation[0], offset)
    columns = _resting_places(out_w, weight.shape[3], stride[1], padding[1], dilation[1], offset)
    output = _sample(input, offset, weight, mask, rows, columns)
    return output if bias is None else output + bias[:, None, None]


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
            stride=self.stride,
            padding=self.padding,
            mask=2 * torch.sigmoid(self.modulator(features)),
        )


@torch.inference_mode()
def has_large_sampling(network: nn.Module, *inputs: Tensor | list[Tensor]) -> bool:
    """Whether any deformable layer of a network samples so many values that its ONNX graph takes minutes to make."""
    sampled = [0]

    def look(layer: nn.Module, _: object, output: Tensor) -> None:
        assert isinstance(layer, DeformableConv2d)
        sampled.append(output[:, 0].numel() * layer.kernel.weight[0].numel())

    layers = [layer for layer in network.modules() if isinstance(layer, DeformableConv2d)]
    hooks = [layer.register_forward_hook(look) for layer in layers]
    try:
        network(*inputs)
    finally:
        for hook in hooks:
            hook.remove()
    return max(sampled) > _LARGE


def _pair(value: int | tuple[int, int]) -> tuple[int, int]:
    return (value, value) if isinstance(value, int) else (value[0], value[1])


def _check_shapes(
    input: Tensor,
    offset: Tensor,
    weight: Tensor,
    mask: Tensor | None,
    stride: tuple[int, int],
    padding: tuple[int, int],
    dilation: tuple[int, int],
) -> tuple[int, int]:
    """Check the shapes and return the size of the output."""
    if input.dim() != 4 or weight.dim() != 4:
        raise ValueError(
            f"input and weight must be 4-d; got {tuple(input.shape)} and {tuple(weight.shape)}"
        )
    batch, channels = input.shape[:2]
    if channels % weight.shape[1] or weight.shape[0] % (channels // weight.shape[1]):
        raise ValueError(
            f"weight must have shape (C_out, {channels} / groups, k_h, k_w); got {tuple(weight.shape)}"
        )
    out_h, out_w = (
        (input.shape[2 + i] + 2 * padding[i] - dilation[i] * (weight.shape[2 + i] - 1) - 1)
        // stride[i]
        + 1
        for i in range(2)
    )
    if min(out_h, out_w) < 1:
        raise ValueError(f"the kernel does not fit: the output would have size {(out_h, out_w)}")
    taps = weight.shape[2] * weight.shape[3]
    groups = max(offset.shape[1] // (2 * taps), 1) if offset.dim() == 4 else 1
    wanted = (batch, 2 * groups * taps, out_h, out_w)
    if tuple(offset.shape) != wanted:
        raise ValueError(f"offset must have shape {wanted}; got {tuple(offset.shape)}")
    if channels % groups:
        raise ValueError(f"the {groups} offset groups must divide the {channels} input channels")
    wanted = (batch, groups * taps, out_h, out_w)
    if mask is not None and tuple(mask.shape) != wanted:
        raise ValueError(f"mask must have shape {wanted}; got {tuple(mask.shape)}")
    return out_h, out_w


def _resting_places(
    out: int, kernel: int, stride: int, padding: int, dilation: int, like: Tensor
) -> Tensor:
    """Positions of the taps of each output along one axis at zero offset, in pixels, ``(out, kernel)``."""
    dtype = torch.promote_types(
        like.dtype, torch.float32
    )  # half precision cannot represent pixel indices
    first = torch.arange(out, device=like.device, dtype=dtype) * stride - padding
    return first[:, None] + torch.arange(kernel, device=like.device, dtype=dtype) * dilation


def _sampling_grid(offset: Tensor, rows: Tensor, columns: Tensor, size: tuple[int, int]) -> Tensor:
    """Normalised sampling positions, ``(B * G, k_h * k_w, H_out * W_out, 2)``, x first.

    Pixel p of n lies at (2 p + 1) / n - 1: grid_sample's convention without aligned corners, which
    unlike the aligned one holds for a single pixel too.
    """
    (out_h, k_h), (out_w, k_w) = rows.shape, columns.shape
    height, width = size
    moves = offset.reshape(-1, k_h, k_w, 2, out_h, out_w)
    rest_y = ((2 * rows.T + 1) / height - 1)[:, None, :, None]
    rest_x = ((2 * columns.T + 1) / width - 1)[None, :, None, :]
    y = torch.add(rest_y, moves[:, :, :, 0], alpha=2 / height)  # (B * G, k_h, k_w, H_out, W_out)
    x = torch.add(rest_x, moves[:, :, :, 1], alpha=2 / width)
    return torch.stack((x, y), dim=-1).view(-1, k_h * k_w, out_h * out_w, 2)


def _sample(
    input: Tensor,
    offset: Tensor,
    weight: Tensor,
    mask: Tensor | None,
    rows: Tensor,
    columns: Tensor,
) -> Tensor:
    """The convolution without its bias, ``(B, C_out, H_out, W_out)``; arguments as of `deform_conv2d`.

    Args:
        input, offset, weight, mask: as given.
        rows: positions of the taps of each output row at zero offset, in pixels, ``(H_out, k_h)``.
        columns: the same along the other axis, ``(W_out, k_w)``.
    """
    batch, channels = input.shape[:2]
    out_h, out_w = offset.shape[2:]
    taps = weight.shape[2] * weight.shape[3]
    groups = offset.shape[1] // (2 * taps)
    grid = _sampling_grid(offset, rows, columns, (input.shape[2], input.shape[3]))
    maps = input.reshape(batch * groups, channels // groups, *input.shape[2:]).to(grid.dtype)
    factors = grid.new_ones(()) if mask is None else mask.to(grid.dtype)
    factors = factors.expand(batch, groups * taps, out_h, out_w).reshape(
        batch * groups, 1, taps, -1
    )
    images, places = batch, out_h * out_w
    if input.device.type == "cpu":
        places = max(1, min(places, _CPU_CHUNK // (channels * taps)))
        images = max(1, min(batch, _CPU_CHUNK // (channels * taps * places)))
    split = [torch.split(tensor, images * groups) for tensor in (maps, grid, factors)]
    chunks = [
        _sample_and_combine(some_maps, some_grid, some_factors, weight, channels, places)
        for some_maps, some_grid, some_factors in zip(*split)
    ]
    return _join(chunks, dim=0).view(batch, weight.shape[0], out_h, out_w)


def _sample_and_combine(
    maps: Tensor, grid: Tensor, factors: Tensor, weight: Tensor, channels: int, places: int
) -> Tensor:
    """Sample the taps of some images, `places` outputs at a time, and multiply them by the kernel.

    `split` rather than slices: the gradient of n slices is n full-size sums.

    Args:
        maps: inputs, ``(b * G, C_in / G, H, W)``.
        grid: sampling positions, ``(b * G, taps, H_out * W_out, 2)``.
        factors: tap factors, ``(b * G, 1, taps, H_out * W_out)``.
        weight: kernel, ``(C_out, C_in / groups, k_h, k_w)``.
        channels: C_in.
        places: outputs handled at once.

    Returns:
        ``(b, C_out, H_out * W_out)``.
    """
    inside = weight[0].numel()
    weight_groups = channels // weight.shape[1]
    pieces = []
    for positions, scale in zip(
        torch.split(grid, places, dim=2), torch.split(factors, places, dim=3)
    ):
        sampled = F.grid_sample(
            maps, positions, mode="bilinear", padding_mode="zeros", align_corners=False
        )
        columns = (sampled * scale).to(weight.dtype)
        columns = columns.view(-1, weight_groups, inside, columns.shape[-1])
        if weight_groups == 1:
            pieces.append(torch.matmul(weight.flatten(1), columns[:, 0]))
        else:
            kernels = weight.reshape(weight_groups, -1, inside)
            pieces.append(torch.matmul(kernels, columns).flatten(1, 2))
    return _join(pieces, dim=-1)


def _join(pieces: list[Tensor], dim: int) -> Tensor:
    return pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim)
