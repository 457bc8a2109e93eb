"""Folders that one process at a time writes to."""

from __future__ import annotations

from pathlib import Path
from threading import Thread

import pytest

from erfsfm.common.errors import BusyError
from erfsfm.common.files import FolderLock


def test_a_folder_is_held_until_the_end_of_the_block(tmp_path: Path) -> None:
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


def test_who_waits_holds_a_folder_after_the_other(tmp_path: Path) -> None:
    events = []

    def wait() -> None:
        with FolderLock() as other:
            other.wait_for(tmp_path)
            events.append("waited")

    with FolderLock() as lock:
        lock.wait_for(tmp_path)
        thread = Thread(target=wait)
        thread.start()
        thread.join(0.3)
        events.append("held")
    thread.join(30)
    assert events == ["held", "waited"]


def test_where_no_folder_can_be_made_there_is_nothing_to_hold(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with FolderLock() as lock:
        lock.take(tmp_path / "file" / "run")
