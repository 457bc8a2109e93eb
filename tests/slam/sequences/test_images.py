"""Image files as the frames of a sequence."""

from pathlib import Path

import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import list_images
from erfsfm.common.readers.numbering import by_name
from slam.runtime.errors import SequenceError
from slam.sequences.images import ImageFiles


def test_the_first_readable_image_gives_the_size_and_another_is_named(tmp_path: Path, images) -> None:
    images(tmp_path, ["0.png", "1.png", "3.png"])
    images(tmp_path, ["2.png"], width=41)
    (tmp_path / "0.png").write_bytes(b"")
    files = ImageFiles(by_name(list_images(tmp_path)))
    assert (files.width, files.height, len(files)) == (40, 24, 4) and files.read(1)[0, 0, 0] == 10
    with pytest.raises(DataError, match=r"0\.png is empty"):
        files.read(0)
    with pytest.raises(SequenceError, match=r"2\.png is 41x24, but 1\.png is 40x24"):
        files.read(2)
