"""The number format of networks that are trained on a CPU."""

from __future__ import annotations

import torch

_BFLOAT16 = ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16")  # capabilities of a processor


def has_bfloat16() -> bool:
    """Whether the CPU computes with bfloat16; without instructions for it, it takes six times as long as float32."""
    able = torch.cpu.get_capabilities()
    return any(able.get(name) for name in _BFLOAT16)
