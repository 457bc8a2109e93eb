"""Figures are replaced by figures, other images stay."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from erfsfm.common.errors import ConfigError
from erfsfm.common.files import FIGURE_SUFFIXES, save_figure


@pytest.mark.parametrize("suffix", FIGURE_SUFFIXES)
def test_a_figure_replaces_a_figure_and_equal_ones_are_equal_files(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"figure{suffix}"
    if suffix != ".svg":  # its ids are random without the style of our plots
        save_figure(Figure(), path, dpi=50)
        before = path.read_bytes()
        save_figure(Figure(), path, dpi=50)
        assert path.read_bytes() == before
    else:
        save_figure(Figure(), path, dpi=50)
        save_figure(Figure(), path, dpi=60)


def test_another_image_stays(tmp_path: Path) -> None:
    image = tmp_path / "000000.png"
    cv2.imwrite(str(image), np.zeros((4, 4, 3), np.uint8))
    before = image.read_bytes()
    with pytest.raises(ConfigError, match=r"000000\.png exists and is no figure of erfsfm: choose another --output"):
        save_figure(Figure(), image, dpi=50)
    assert image.read_bytes() == before
