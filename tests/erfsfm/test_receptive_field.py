import pytest

from erfsfm.receptive_field import measure_fields, street_snippet


def by_name(names):
    return {(row.name, row.fidelity): row for row in measure_fields(names, "default", street_snippet(5, 128, 416))}


def test_the_papers_dilated_network_follows_ours_and_reads_every_second_row_and_column():
    rows = by_name(["posenet", "erf-posenet-dilated"])
    assert list(rows) == [("posenet", "default"), ("erf-posenet-dilated", "default"), ("erf-posenet-dilated", "paper")]
    paper, ours = rows["erf-posenet-dilated", "paper"].summary(), rows["erf-posenet-dilated", "default"].summary()
    assert (paper["theoretical_px"], paper["columns"], paper["rows"]) == (301, 297, 127)
    assert paper["share"] == pytest.approx(0.179, abs=6e-4)
    assert paper["share_of_all_outputs"] == pytest.approx(0.25)
    assert ours["share_of_all_outputs"] == 1.0
    assert paper["effective_share_95"] <= paper["share"]
    for at in (rows["erf-posenet-dilated", "paper"].seen.gradient > 0).nonzero(as_tuple=True):
        assert (at % 2 == 1).all()
    plain = rows["posenet", "default"].summary()
    assert (plain["theoretical_px"], plain["offsets_px"], plain["columns"]) == (263, 0.0, 263)


def test_pushed_taps():
    summary = by_name(["erf-posenet-dfc"])["erf-posenet-dfc", "default"].summary()
    assert (summary["theoretical_px"], summary["theoretical_at_rest_px"]) == (511, 263)
    assert (summary["offsets_px"], summary["columns"]) == (1.0, 415)
    assert summary["share"] == pytest.approx(0.998, abs=6e-4)
