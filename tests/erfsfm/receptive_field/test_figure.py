import cv2
import pytest

from erfsfm.receptive_field.figure import draw_fields
from erfsfm.receptive_field.measure import measure_fields
from erfsfm.receptive_field.street import street_snippet

SNIPPET = street_snippet(5, 64, 128)


@pytest.fixture(scope="module")
def rows():
    return measure_fields(["posenet", "erf-posenet-dilated"], "paper", SNIPPET)


def test_the_picture_shows_what_is_read(tmp_path, rows):
    draw_fields(rows, SNIPPET[2], tmp_path / "field.png")
    picture = cv2.imread(str(tmp_path / "field.png"))
    assert picture.shape[1] > picture.shape[0] > 300
    draw_fields(rows[::-1], SNIPPET[2], tmp_path / "other.png")
    assert (cv2.imread(str(tmp_path / "other.png")) != picture).any()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["field.png", "other.png"], "nothing half written"
