"""Files appear whole or not at all."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest

from erfsfm.common.files import read_bytes, read_text, write_atomically


@pytest.mark.parametrize("through", ["itself", "a link"])
def test_a_pipe_or_a_device_keeps_its_place(tmp_path: Path, through: str) -> None:
    """A superuser's rename would put a file there, also in the place of /dev/null."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    (tmp_path / "link").symlink_to(pipe)
    with pytest.raises(OSError, match="is a device or a pipe: give the name of a file"):
        write_atomically(pipe if through == "itself" else tmp_path / "link", lambda path: path.write_text("x"))
    assert pipe.is_fifo() and (tmp_path / "link").is_symlink() and len(list(tmp_path.iterdir())) == 2


def test_a_disk_that_is_full_names_the_file(tmp_path: Path) -> None:
    target = tmp_path / "new" / "depth.png"

    def fill(path: Path) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"depth\.png: cannot be written \(No space left on device\)$"):
        write_atomically(target, fill)
    assert list(target.parent.iterdir()) == []


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match="larger than 1024 MiB"):
        read_bytes(tmp_path / "sparse", 2**30)


def test_a_pipe_is_read(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=lambda: pipe.write_text("a\r\nb"))
    writer.start()
    assert read_text(pipe) == "a\nb"
    writer.join()
