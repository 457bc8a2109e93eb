"""A file appears whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam.runtime.errors import RunError, SlamError
from slam.runtime.files import write_atomically


def test_makes_folders_and_replaces_what_was_there(tmp_path: Path):
    path = tmp_path / "a" / "b" / "map.ply"
    for text in ("old", "new"):

        def fill(partial: Path, text: str = text) -> None:
            partial.write_text(text)
            assert (
                partial.suffix == ".ply"
                and partial.parent == path.parent
                and partial.name.startswith(".")
            )

        write_atomically(path, fill)
        assert path.read_text() == text
    assert [p.name for p in path.parent.iterdir()] == ["map.ply"]


@pytest.mark.parametrize(
    "failure", [OSError(28, "No space left on device"), RunError("empty"), KeyboardInterrupt()]
)
def test_after_any_failure_the_old_file_stays_and_no_partial_file(
    tmp_path: Path, failure: BaseException
):
    path = tmp_path / "run.log"
    path.write_text("old")

    def fill(partial: Path) -> None:
        partial.write_text("half")
        raise failure

    full_disk = pytest.raises(
        SlamError, match=r"run\.log: cannot be written \(No space left on device\)$"
    )
    with full_disk if isinstance(failure, OSError) else pytest.raises(type(failure)):
        write_atomically(path, fill)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["run.log"]
