"""GPS tracks as they are written, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.runtime.errors import SequenceError
from slam.sequences.gps_track import read_gps


def written(folder: Path, text: str) -> Path:
    path = folder / "track"
    path.write_text(text)
    return path


def test_csv(tmp_path: Path):
    text = "stamp, latitude, longitude, altitude\n0.0,49.0,8.4,115\n1.0,49.00001,8.4,115.5\n"
    track = read_gps(written(tmp_path, text))
    np.testing.assert_array_equal(track.stamps, [0.0, 1.0])
    np.testing.assert_array_equal(track.places, [[49.0, 8.4, 115.0], [49.00001, 8.4, 115.5]])
    np.testing.assert_array_equal(track.dilution, 1.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,lat\n1,2\n", "lacks longitude: its first row"),
        ("<?xml version='1.0'?><gpx></gpx>", "XML, such as GPX, or NMEA, which are not read"),
        (
            "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n",
            "convert it to CSV",
        ),
        ("t,lat,lon,speed\n0,49,8,46\n1,49.00012,8,46\n2,49.00024,8,46\n", "speed_kmh"),
        ("stamp,latitude,longitude,altitude\n", "holds no GPS fix"),
        ("stamp,latitude,longitude,altitude\n0,95,8,100\n", "line 2: no GPS fix"),
        ("stamp,latitude,longitude,altitude\n0,x,8,100\n", "line 2: no GPS fix"),
        ("stamp,latitude,longitude,altitude\n1,49,8,100\n1,49,8,100\n", "stamps must increase"),
        (
            "stamp,latitude,longitude,altitude\n1,49,8,100\n2,50,8,100\n3,51,8,100\n",
            "fixes move at 11119[45] m/s",
        ),
    ],
)
def test_what_is_no_track(tmp_path: Path, text: str, said: str):
    with pytest.raises(SequenceError, match=said):
        read_gps(written(tmp_path, text))


def test_bad_fixes_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    rows = [f"{k},49.000{k},8,100" for k in range(8)]
    rows[3], rows[5] = "3,nan,8,100", "4,49.0004,8,100"
    (tmp_path / "track").write_text("\n".join(["stamp,latitude,longitude,altitude", *rows, "9,,,"]))
    assert read_gps(tmp_path / "track").stamps.tolist() == [0, 1, 2, 4, 6, 7]
    assert "3 of 9 rows" in caplog.text and "line 5" in caplog.text


def test_a_dash_cam_that_gives_no_altitude(tmp_path: Path):
    text = "Time,Lat,Lon,Speed (km/h)\n2026-05-03T12:30:05Z,49,8,36\n2026-05-03T12:30:06Z,49.00009,8,\n"
    track = read_gps(written(tmp_path, text))
    assert track.stamps.tolist() == [1777811405.0, 1777811406.0]
    assert track.places[:, :2].tolist() == [[49.0, 8.0], [49.00009, 8.0]]
    assert np.isnan(track.places[:, 2]).all()
    np.testing.assert_allclose(track.speeds, [10.0, np.nan])
