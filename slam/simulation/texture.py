"""What textures are made of: noise and patterns, filtered over the footprint of a pixel."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.frames import Float32Array

Lengths = NDArray[np.floating[Any]]
Octave = tuple[float, float, float]  # of noise: wavelength along u and along v, metres; amplitude

_SIZE = 256  # lattice cells before the noise repeats


@functools.cache
def _lattice() -> Float32Array:
    """Random values in [-1, 1], flattened ``(_SIZE ** 2,)``."""
    return np.random.default_rng(20261121).uniform(-1.0, 1.0, _SIZE * _SIZE).astype(np.float32)


def value_noise(u: Lengths, v: Lengths) -> Lengths:
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


def cell_hash(u: Lengths, v: Lengths, salt: int) -> Lengths:
    """A random number in [0, 1] for each integer cell, ``(N,)``."""
    i = (np.floor(u).astype(np.int32) + 37 * salt) & 255
    j = (np.floor(v).astype(np.int32) + 101 * salt) & 255
    return 0.5 + 0.5 * np.take(_lattice(), (i << 8) | j)


def mix(a: Lengths | np.floating[Any], b: Lengths | np.floating[Any], fraction: Lengths) -> Lengths:
    """Blend colours ``(3, N)`` by a weight ``(N,)``."""
    return a + fraction * (b - a)


@dataclass(frozen=True)
class Axis:
    """Coordinates of pixels along one axis of a texture; every field is ``(N,)``, metres."""

    at: Lengths  # along the axis
    size: Float32Array  # footprint of the pixel
    shift: Lengths  # offset of the instance in the noise

    def on(self, at: Lengths) -> "Axis":
        """Pixels of the same size at other coordinates ``(N,)``."""
        return Axis(at, self.size, self.shift)

    def stripes(
        self, period: Lengths | float, width: Lengths | float, moved: float = 0.0
    ) -> Lengths:
        """Fraction of each pixel, moved on, that stripes [k period, k period + width] cover."""
        half = 0.5 * np.maximum(self.size, 1e-4)
        x = self.at + moved

        def integral(at: Lengths) -> Lengths:
            whole = np.floor(at / period)
            return whole * width + np.minimum(at - whole * period, width)

        return (integral(x + half) - integral(x - half)) / (2.0 * half)

    def band(self, low: Lengths | float, high: Lengths | float) -> Lengths:
        """Fraction of each pixel covered by the one stripe [low, high]."""
        inverse = 1.0 / np.maximum(self.size, 1e-4)
        after, beyond = (np.clip((self.at - edge) * inverse + 0.5, 0, 1) for edge in (low, high))
        return after - beyond


@dataclass(frozen=True)
class Texels:
    """Pixels of one material: where on its texture, and how their instances look."""

    u: Axis  # along the surface
    v: Axis  # across or up the surface
    first: Float32Array  # colour of the instance, (3, N)
    second: Float32Array  # its other colour, (3, N)
    parameters: Float32Array  # of its texture, (PARAMETERS, N)

    @property
    def size(self) -> Lengths:
        """The larger extent of each pixel on the surface, metres, ``(N,)``."""
        return np.maximum(self.u.size, self.v.size)

    def chosen(self, index: NDArray[np.int64]) -> "Texels":
        """Some of them."""
        u, v = (
            Axis(axis.at[index], axis.size[index], axis.shift[index]) for axis in (self.u, self.v)
        )
        tables = (self.first, self.second, self.parameters)
        return Texels(u, v, *(table[:, index] for table in tables))

    def fractal(self, *octaves: Octave) -> Lengths:
        """Sum of noise octaves, each faded out where its waves are smaller than about two pixels."""
        total = np.zeros_like(self.u.at)
        for k, (wave_u, wave_v, amplitude) in enumerate(octaves):
            pixels = np.minimum(wave_u / self.u.size, wave_v / self.v.size)
            weight = np.clip((pixels - 1.2) / 1.8, 0.0, 1.0)
            seen = np.flatnonzero(weight > 0.0)
            u = (self.u.at[seen] + self.u.shift[seen]) / wave_u + 17.3 * k
            v = (self.v.at[seen] + self.v.shift[seen]) / wave_v + 5.7 * k
            total[seen] += amplitude * weight[seen] * value_noise(u, v)
        return total

    def joints(
        self, along: Lengths | float, up: Lengths | float, width: Lengths | float
    ) -> Lengths:
        """Coverage by the joints between tiles of a size along u and up v."""
        return np.maximum(self.u.stripes(along, width), self.v.stripes(up, width))

    def rim(self, border: float) -> Lengths:
        """Coverage by the border of a thing, whose first parameters are its width and height."""
        width, height = self.parameters[:2]
        inside = self.u.band(border, width - border) * self.v.band(border, height - border)
        return 1.0 - inside


# unlit RGB (3, N), about [0, 1], of the pixels of a material
Shader = Callable[[Texels], Lengths]


def grained(*octaves: Octave) -> Shader:
    """One colour under noise."""
    return lambda texels: texels.first * (1.0 + texels.fractal(*octaves))


def slabs(contrast: float, *octaves: Octave) -> Shader:
    """Square slabs of several tones under noise, between joints of the second colour.

    Parameters of the texture: their side and the width of joints, metres, and whether they are
    chequered.
    """

    def shade(texels: Texels) -> Lengths:
        side, joint, checks = texels.parameters[:3]
        u, v = texels.u.at / side, texels.v.at / side
        near = np.clip(side / texels.size / 2.0 - 0.5, 0.0, 1.0)
        tone = contrast * near * (cell_hash(u, v, 1) - 0.5)
        rgb = texels.first * (1.0 + texels.fractal(*octaves) + tone)
        chequered = (np.floor(u) + np.floor(v)) % 2 * checks * near
        rgb = mix(rgb, 0.5 * texels.second, chequered)
        return mix(rgb, texels.second, texels.joints(side, side, joint))

    return shade
