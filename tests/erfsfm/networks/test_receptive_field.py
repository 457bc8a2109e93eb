import math

import pytest
import torch

from erfsfm.networks.presets import build
from erfsfm.networks.receptive_field import (
    field_of,
    measured,
    multiply_adds,
    theoretical,
    theoretical_corner,
)


def small(name, fidelity="default"):
    """The field does not depend on the width: all channels carry the same constant weights."""
    return build(name, fidelity, width=0.1)


@pytest.mark.parametrize(
    "name, fidelity, wanted",
    [
        ("posenet", "paper", 263),
        ("erf-posenet-dfcv2", "paper", 263),
        ("erf-posenet-dilated", "paper", 301),
        ("erf-posenet-dilated", "default", 339),
        ("depthnet", "paper", 787),
        ("erf-depthnet-dfcv2", "default", 787),
        ("erf-depthnet-dilated", "default", 829),
    ],
)
def test_theoretical(name, fidelity, wanted):
    assert theoretical(small(name, fidelity)) == wanted


@pytest.mark.parametrize(
    "name, fidelity, offsets_px",
    [
        ("posenet", "default", 0.0),
        pytest.param("erf-posenet-dilated", "default", 0.0, marks=pytest.mark.slow),
        pytest.param("erf-posenet-dilated", "paper", 0.0, marks=pytest.mark.slow),
        pytest.param("erf-posenet-dfc", "default", 1.0, marks=pytest.mark.slow),
        pytest.param("erf-posenet-dfcv2", "default", 0.5, marks=pytest.mark.slow),
    ],
)
def test_theoretical_corner_is_where_gradients_begin(name, fidelity, offsets_px):
    """On an image large enough for the whole field."""
    network = small(name, fidelity)
    side = theoretical(network, offsets_px)
    size = math.ceil(side / 256) * 256
    field = measured(network, (size, size), offsets_px=offsets_px)
    assert (field.top, field.left) == theoretical_corner(network, field.pixel, offsets_px)
    assert (field.rows, field.columns) == (side, side)


@pytest.mark.parametrize(
    "name, fidelity, size, pixel, box, coverage",
    [
        ("posenet", "default", (128, 416), (0, 2), (128, 263), 0.632),
        ("erf-posenet-dilated", "paper", (128, 416), (0, 1), (127, 297), 0.179),
        ("erf-posenet-dilated", "paper", (188, 620), None, (185, 301), 0.120),
        ("erf-posenet-dilated", "default", (128, 416), (0, 2), (128, 327), 0.733),
        ("erf-depthnet-dfc", "default", (128, 416), None, (128, 416), 1.0),
        ("depthnet-lite0", "default", (128, 416), (2, 6), (128, 416), 1.0),
    ],
)
def test_measured(name, fidelity, size, pixel, box, coverage):
    field = measured(small(name, fidelity), size, pixel)
    assert pixel is None or field.pixel == pixel
    assert (field.rows, field.columns) == box
    assert field.coverage == pytest.approx(coverage, abs=6e-4)


@pytest.mark.parametrize(
    "name, offsets_px, columns, coverage",
    [
        ("erf-posenet-dfc", 0.0, 263, 0.632),
        ("erf-posenet-dfc", 0.5, 415, 0.998),
        ("erf-posenet-dfc", 2.0, 416, 1.0),
        pytest.param("erf-posenet-dfcv2", 0.5, 293, 0.704, marks=pytest.mark.slow),
        pytest.param("erf-posenet-dfcv2", 2.0, 321, 0.767, marks=pytest.mark.slow),
    ],
)
def test_measured_with_taps_pushed_outwards(name, offsets_px, columns, coverage):
    field = measured(small(name), offsets_px=offsets_px)
    assert (field.rows, field.columns) == (128, columns)
    assert field.coverage == pytest.approx(coverage, abs=6e-4)


def test_effective_field_lies_inside_the_measured_one():
    torch.manual_seed(0)
    network = small("posenet")
    field = field_of(network.encoder.eval(), torch.rand(1, 15, 128, 416))
    possible = measured(network).gradient > 0
    assert field.coverage > 0 and not (field.gradient[~possible] > 0).any()


def test_multiply_adds():
    depth = build("depthnet")
    assert multiply_adds(depth) == pytest.approx(3.67e9, rel=2e-3)
    assert multiply_adds(depth, 188, 620) == pytest.approx(8.16e9, rel=2e-3)
    assert depth.training and next(depth.parameters()).device.type == "cpu"
    assert multiply_adds(build("posenet")) == pytest.approx(0.256e9, rel=2e-3)


def test_multiply_adds_of_deformable_layers_include_their_predictors():
    plain, deformable = small("posenet"), small("erf-posenet-dfc")
    extra = 0
    size = [(16, 52), (8, 26), (4, 13), (2, 7), (1, 4)]
    for (height, width), stage in zip(size, list(deformable.encoder.stages)[2:]):
        layer = stage[0][0]
        extra += height * width * (layer.offset.weight.numel() + layer.modulator.weight.numel())
    assert multiply_adds(deformable) == multiply_adds(plain) + extra
