"""Shipped SLAM configurations, and the configuration keys of earlier releases."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

import erfsfm.common.errors
from erfsfm.common.config_tree import OldNames
from erfsfm.common.config_tree import load_config as load_tree
from slam.runtime.errors import ConfigError

M = TypeVar("M", bound=BaseModel)

_HERE = Path(__file__).resolve().parents[1]
SHIPPED = (_HERE.parent / "configs" / "slam", _HERE / "_configs")  # in the source tree, in the wheel

OLD_NAMES = OldNames(
    keys={
        "geometry.foresight": "geometry.predicted_flow",
        "geometry.span_steps": "geometry.rotation_baseline_steps",
        "geometry.mover_sharpness": "geometry.dynamic_mask_sharpness",
        "geometry.shake_rotation_share": "geometry.jitter_rotation_ratio",
        "geometry.shake_direction_share": "geometry.jitter_direction_ratio",
        "geometry.turn_rotation_share": "geometry.turn_rotation_ratio",
        "geometry.jolt_rotation_share": "geometry.neighbour_rotation_ratio",
        "geometry.jolt_direction_share": "geometry.neighbour_direction_ratio",
        "bridging": "gaps",
        "scale.road_top_share": "scale.road_top_ratio",
        "scale.road_bottom_share": "scale.road_bottom_ratio",
        "loops.agreement_share": "loops.agreement_ratio",
        "mapping.max_blocks": "mapping.memory_mb",
    },
    values={("frontend.use", "bridge"): "gaps"},
)


def load_sections(
    model: type[M],
    file_or_name: str | Path | None,
    overrides: Sequence[str],
    sections: Collection[str] | None = None,
) -> M:
    """Read a YAML file, or one of those under ``configs/slam`` by its name, and apply ``section.key=value`` overrides.

    ``sections`` are those of the file that are read, without unknown keys; None for all of them.

    Raises:
        ConfigError: one line that names the key or file, what came and what is allowed.
    """
    try:
        return load_tree(model, file_or_name, overrides, SHIPPED, OLD_NAMES, sections)
    except erfsfm.common.errors.ConfigError as error:
        raise ConfigError(str(error)) from error
