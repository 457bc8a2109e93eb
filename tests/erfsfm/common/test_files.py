"""Files appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from erfsfm.common.errors import BusyError, ConfigError
from erfsfm.common.files import (
    FIGURE_SUFFIXES,
    FolderLock,
    read_bytes,
    save_figure,
    write_atomically,
)


def test_a_pipe_or_a_device_keeps_its_place(tmp_path: Path):
    """A superuser's rename would put a file there, also in the place of /dev/null."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="is a device or a pipe: give the name of a file"):
        write_atomically(pipe, lambda path: path.write_text("x"))
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match="larger than 1024 MiB"):
        read_bytes(tmp_path / "sparse", 2**30)


@pytest.mark.parametrize("suffix", FIGURE_SUFFIXES)
def test_a_figure_replaces_a_figure_and_equal_ones_are_equal_files(tmp_path: Path, suffix: str):
    path, contents = tmp_path / f"figure{suffix}", []
    for _ in range(2):
        save_figure(Figure(), path, dpi=50)
        contents.append(path.read_bytes())
    assert (
        contents[0] == contents[1] or suffix == ".svg"
    )  # its ids are random without the style of our plots


def test_another_image_stays(tmp_path: Path):
    image = tmp_path / "000000.png"
    cv2.imwrite(str(image), np.zeros((4, 4, 3), np.uint8))
    before = image.read_bytes()
    with pytest.raises(
        ConfigError,
        match=r"000000\.png is none of ours and would be replaced: choose another --output",
    ):
        save_figure(Figure(), image, dpi=50)
    assert image.read_bytes() == before


def test_a_folder_is_held_until_the_end_of_the_block(tmp_path: Path):
    with FolderLock() as lock:
        lock.take(tmp_path / "run")
        with (
            FolderLock() as other,
            pytest.raises(BusyError, match=r"another process writes to .*run: wait"),
        ):
            other.take(tmp_path / "run")
    with FolderLock() as lock:
        lock.take(tmp_path / "run")
    assert not list((tmp_path / "run").iterdir())


def test_who_waits_holds_a_folder_after_the_other(tmp_path: Path):
    events = []

    def wait() -> None:
        with FolderLock() as other:
            other.take(tmp_path, waits=True)
            events.append("waited")

    with FolderLock() as lock:
        lock.take(tmp_path, waits=True)
        thread = Thread(target=wait)
        thread.start()
        thread.join(0.3)
        events.append("held")
    thread.join(30)
    assert events == ["held", "waited"]
