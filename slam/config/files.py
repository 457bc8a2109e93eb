"""Shipped SLAM configurations."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

import erfsfm.common.errors
from erfsfm.common.config_tree import load_config as load_tree
from slam.runtime.errors import ConfigError

M = TypeVar("M", bound=BaseModel)

_HERE = Path(__file__).resolve().parents[1]
SHIPPED = (_HERE.parent / "configs" / "slam", _HERE / "_configs")  # in the source tree, in the wheel


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
        return load_tree(model, file_or_name, overrides, SHIPPED, sections)
    except erfsfm.common.errors.ConfigError as error:
        raise ConfigError(str(error)) from error
