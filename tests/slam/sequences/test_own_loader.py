"""The loader of docs/design/loaders.md works as the page says."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from slam.commands.doctor import examine
from slam.runtime.errors import MissingFrameError
from slam.sequences import catalogue
from slam.sequences.catalogue import open_sequence

PAGE = Path(__file__).parents[3] / "docs/design/loaders.md"


def test_the_example_is_a_loader(tmp_path: Path, images, camera_yaml: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len([line for line in code.splitlines() if line and not line.startswith(("import", "from", '"""'))]) <= 30
    (tmp_path / "drives.py").write_text(code)
    spec = importlib.util.spec_from_file_location("drives", tmp_path / "drives.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(catalogue, "LOADERS", (module.LOADER, *catalogue.LOADERS))

    drive = tmp_path / "monday"
    images(drive / "left", [f"{k}.png" for k in range(4)])
    (drive / "left/1.png").unlink()
    (drive / "drive.csv").write_text("".join(f"left/{k}.png,{10 + 0.1 * k},0,0,{k},0,0,0,1\n" for k in range(4)))
    (drive / "camera.yaml").write_text(camera_yaml)
    sequence = open_sequence(drive)
    assert sequence.stamps == pytest.approx([10, 10.1, 10.2, 10.3])
    assert sequence.reference is not None and sequence.reference[:, 2, 3] == pytest.approx(np.arange(4))
    assert sequence.frame(2).image[0, 0, 0] == 20
    with pytest.raises(MissingFrameError, match=r"no image 1\.png"):
        sequence.frame(1)
    line = examine(drive)[-1]
    assert line.startswith("ok       sequence monday: 4 frames of 40x24, true poses") and line.endswith("(our drives)")
