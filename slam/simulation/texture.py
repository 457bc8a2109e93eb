"""What textures are made of: noise and patterns, filtered over the footprint of a pixel."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import Float32Array

Lengths = NDArray[np.floating[Any]]

_SIZE = 256  # lattice cells before the noise repeats


@dataclass(frozen=True)
class Texels:
    """Texture coordinates of the pixels of one material; every field is ``(N,)``, metres."""

    u: Float32Array  # along the surface
    v: Float32Array  # across or up the surface
    u_size: Float32Array  # footprint of the pixel along u
    v_size: Float32Array  # footprint of the pixel along v
    shift: Float32Array  # offset of the instance in the noise along u
    shift_v: Float32Array  # the same along v


# unlit RGB (3, N), about [0, 1], of texels by the two colours (2, 3, N) and the parameters
# (PARAMETERS, N) of instances
Shader = Callable[[Texels, Float32Array, Float32Array], Float32Array]


@functools.cache
def _lattice() -> Float32Array:
    """Random values in [-1, 1], flattened ``(_SIZE ** 2,)``."""
    return np.random.default_rng(20261121).uniform(-1.0, 1.0, _SIZE * _SIZE).astype(np.float32)


def value_noise(u: Float32Array, v: Float32Array) -> Float32Array:
    """Smooth noise in [-1, 1] with one lattice cell per unit, ``(N,)``."""
    table = _lattice()
    whole_u, whole_v = np.floor(u), np.floor(v)
    a, b = u - whole_u, v - whole_v
    a *= a * (3.0 - 2.0 * a)
    b *= b * (3.0 - 2.0 * b)
    i, j = whole_u.astype(np.int32), whole_v.astype(np.int32)
    left, right = (i & 255) << 8, ((i + 1) & 255) << 8
    low, high = j & 255, (j + 1) & 255
    bottom = np.take(table, left | low)
    bottom += a * (np.take(table, right | low) - bottom)
    top = np.take(table, left | high)
    top += a * (np.take(table, right | high) - top)
    top -= bottom
    top *= b
    top += bottom
    return top


def cell_hash(u: Float32Array, v: Float32Array, salt: int) -> Float32Array:
    """A random number in [0, 1] for each integer cell, ``(N,)``."""
    i = (np.floor(u).astype(np.int32) + 37 * salt) & 255
    j = (np.floor(v).astype(np.int32) + 101 * salt) & 255
    return np.asarray(0.5 + 0.5 * np.take(_lattice(), (i << 8) | j))


def fractal(texels: Texels, *octaves: tuple[float, float, float]) -> Float32Array:
    """Sum of noise octaves, each faded out where its waves are smaller than about two pixels.

    An octave is the wavelength along u and along v in metres, and the amplitude.
    """
    total = np.zeros_like(texels.u)
    for k, (wave_u, wave_v, amplitude) in enumerate(octaves):
        pixels = np.minimum(wave_u / texels.u_size, wave_v / texels.v_size)
        weight = np.clip((pixels - 1.2) / 1.8, 0.0, 1.0)
        seen = np.flatnonzero(weight > 0.0)
        u = (texels.u[seen] + texels.shift[seen]) / wave_u + 17.3 * k
        v = (texels.v[seen] + texels.shift_v[seen]) / wave_v + 5.7 * k
        total[seen] += amplitude * weight[seen] * value_noise(u, v)
    return total


def stripes(
    x: Lengths, size: Lengths, period: Lengths | float, width: Lengths | float
) -> Float32Array:
    """Fraction of each pixel of a ``size`` that stripes [k period, k period + width] cover."""
    half = 0.5 * np.maximum(size, 1e-4)

    def integral(at: Lengths) -> Lengths:
        whole = np.floor(at / period)
        return np.asarray(whole * width + np.minimum(at - whole * period, width))

    return np.asarray((integral(x + half) - integral(x - half)) / (2.0 * half))


def band(x: Lengths, size: Lengths, low: Lengths | float, high: Lengths | float) -> Float32Array:
    """Fraction of each pixel covered by the one stripe [low, high]."""
    inverse = 1.0 / np.maximum(size, 1e-4)
    return np.asarray(
        np.clip((x - low) * inverse + 0.5, 0, 1) - np.clip((x - high) * inverse + 0.5, 0, 1)
    )


def mix(
    a: Lengths | np.floating[Any], b: Lengths | np.floating[Any], fraction: Lengths
) -> Float32Array:
    """Blend colours ``(3, N)`` by a weight ``(N,)``."""
    return np.asarray(a + fraction * (b - a), dtype=np.float32)


def pixel_size(texels: Texels) -> Float32Array:
    """The larger extent of each pixel on the surface, metres, ``(N,)``."""
    return np.maximum(texels.u_size, texels.v_size)


def grained(*octaves: tuple[float, float, float]) -> Shader:
    """One colour under noise."""
    return lambda texels, colours, _: np.asarray(colours[0] * (1.0 + fractal(texels, *octaves)))
