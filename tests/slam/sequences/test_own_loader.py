"""The loader and the source of depth of the pages work in packages of their own, as the pages say."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from slam.commands.doctor import examine
from slam.config.sections import load_config
from slam.frames import Frame, Intrinsics
from slam.prediction.assembly import open_depth
from slam.runtime.errors import ConfigError, MissingFrameError
from slam.runtime.imports import plug_ins
from slam.sequences.catalogue import open_sequence

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path], str]]:
    """Makes a package of the code and the entry point of a page; returns its code."""

    def package(page: Path) -> str:
        text = page.read_text(encoding="utf-8")
        (entry_point,) = re.findall(
            r"```toml\n\[project\.entry-points\.\"(.*?)\"\]\n(.*?)```", text, re.DOTALL
        )
        group, (module,) = entry_point[0], re.findall(r"\"(.*?):", entry_point[1])
        code = text.partition(entry_point[1])[2].partition("```python\n")[2].partition("```")[0]
        (tmp_path / "site" / f"{module}-1.dist-info").mkdir(parents=True)
        (tmp_path / "site" / f"{module}.py").write_text(code)
        (tmp_path / "site" / f"{module}-1.dist-info" / "METADATA").write_text(
            f"Name: {module}\nVersion: 1\n"
        )
        quoted = entry_point[1].replace('"', "")
        (tmp_path / "site" / f"{module}-1.dist-info" / "entry_points.txt").write_text(
            f"[{group}]\n{quoted}"
        )
        monkeypatch.syspath_prepend(tmp_path / "site")
        monkeypatch.delitem(sys.modules, module, raising=False)
        plug_ins.cache_clear()
        return code

    yield package
    plug_ins.cache_clear()


def test_the_example_is_a_loader(
    tmp_path: Path, images, camera_yaml: str, install: Callable[[Path], str]
) -> None:
    code = install(DOCS / "design" / "loaders.md")
    assert (
        len(
            [
                line
                for line in code.splitlines()
                if line and not line.startswith(("import", "from", '"""'))
            ]
        )
        <= 30
    )
    drive = tmp_path / "monday"
    images(drive / "left", [f"{k}.png" for k in range(4)])
    (drive / "left/1.png").unlink()
    (drive / "drive.csv").write_text(
        "".join(f"left/{k}.png,{10 + 0.1 * k},0,0,{k},0,0,0,1\n" for k in range(4))
    )
    (drive / "camera.yaml").write_text(camera_yaml)
    sequence = open_sequence(drive)
    assert sequence.stamps == pytest.approx([10, 10.1, 10.2, 10.3])
    assert sequence.reference is not None and sequence.reference[:, 2, 3] == pytest.approx(
        np.arange(4)
    )
    assert sequence.frame(2).image[0, 0, 0] == 20
    with pytest.raises(MissingFrameError, match=r"no image 1\.png"):
        sequence.frame(1)
    line = examine(drive)[-1]
    assert line.startswith(
        "ok       sequence monday: 4 frames of 40x24, true poses"
    ) and line.endswith("(our drives)")


def test_the_example_is_a_source_of_depth(install: Callable[[Path], str]) -> None:
    with pytest.raises(ConfigError, match=r"network, onnx:FILE, npy:FOLDER or png:FOLDER"):
        load_config(None, ["depth.source=flat:2.5"])
    install(DOCS / "depth.md")
    depth = load_config(None, ["depth.source=flat:2.5"]).depth
    source = open_depth(depth, Intrinsics(40, 24, 30.0, 30.0, 19.5, 11.5), None)
    assert source is not None and len(source.sha256) == 64
    disparity = source.disparity(Frame(0, 0.0, np.zeros((24, 40, 3), np.uint8)))
    np.testing.assert_allclose(disparity, np.full((24, 40), 0.4), rtol=1e-6)
