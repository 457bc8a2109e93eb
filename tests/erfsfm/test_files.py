"""Files appear whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from erfsfm.files import write_atomically


def test_a_disk_that_is_full_names_the_file(tmp_path: Path) -> None:
    target = tmp_path / "new" / "depth.png"

    def fill(path: Path) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"depth\.png: cannot be written \(No space left on device\)$"):
        write_atomically(target, fill)
    assert list(target.parent.iterdir()) == []
