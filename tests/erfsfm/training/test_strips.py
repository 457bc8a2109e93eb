"""Images with a strip of another one of their batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from erfsfm.common.errors import ConfigError
from erfsfm.config import load_experiment
from erfsfm.training.strips import NARROWEST, WIDEST, with_strips

COUNT, HEIGHT, WIDTH = 8, 4, 100


def numbered() -> dict[str, torch.Tensor]:
    """A batch in which every value is the number of its image."""
    number = torch.arange(COUNT)[:, None, None, None]
    label = number.float().expand(COUNT, 1, HEIGHT, WIDTH)
    target = number.expand(COUNT, 3, HEIGHT, WIDTH).float()
    return {"target": target, "least": label, "most": label + 0.5, "K": torch.eye(3).expand(COUNT, 3, 3)}


def test_a_strip_has_the_label_of_its_image() -> None:
    mixed = with_strips(numbered(), 1.0, np.random.default_rng(0))
    assert torch.equal(mixed["target"][:, :1], mixed["least"])
    assert torch.equal(mixed["least"] + 0.5, mixed["most"])
    assert torch.equal(mixed["K"], numbered()["K"])


def test_strips_are_upright_and_of_one_other_image() -> None:
    mixed = with_strips(numbered(), 1.0, np.random.default_rng(1))["least"][:, 0]
    assert torch.equal(mixed, mixed[:, :1].expand_as(mixed)), "columns are of one image"
    foreign = 0
    for number, row in enumerate(mixed[:, 0]):
        others = row[row != number]
        assert len(others.unique()) <= 1
        if len(others):
            foreign += 1
            assert NARROWEST * WIDTH - 1 <= len(others) <= WIDEST * WIDTH + 1
            (columns,) = torch.nonzero(row != number, as_tuple=True)
            assert int(columns[-1] - columns[0]) + 1 == len(columns)
    assert foreign >= COUNT - 3, "a permutation leaves few images in their place"


def test_no_chance_leaves_the_batch() -> None:
    mixed = with_strips(numbered(), 0.0, np.random.default_rng(0))
    for name, tensor in numbered().items():
        assert torch.equal(mixed[name], tensor)


def test_images_that_others_are_warped_to_are_not_mixed() -> None:
    with pytest.raises(ConfigError, match=r"data\.strips needs labels alone"):
        load_experiment("default", ["data.strips=0.5"])
