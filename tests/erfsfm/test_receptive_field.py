import pytest

from erfsfm.receptive_field import measure_fields, street_snippet

SNIPPET = street_snippet(5, 128, 416)


def by_name(names, **options):
    return {
        (row.summary["name"], row.summary["fidelity"]): row.summary
        for row in measure_fields(names, options.pop("fidelity", "default"), SNIPPET, **options)
    }


@pytest.mark.slow
def test_the_papers_dilated_network_follows_ours():
    rows = by_name(["posenet", "erf-posenet-dilated"])
    assert list(rows) == [
        ("posenet", "default"),
        ("erf-posenet-dilated", "default"),
        ("erf-posenet-dilated", "paper"),
    ]
    paper, ours = rows["erf-posenet-dilated", "paper"], rows["erf-posenet-dilated", "default"]
    assert (paper["theoretical_px"], paper["columns"], paper["rows"]) == (301, 297, 127)
    assert paper["share"] == pytest.approx(0.179, abs=6e-4)
    assert paper["share_of_all_outputs"] == pytest.approx(0.25)
    assert ours["share_of_all_outputs"] == 1.0
    assert paper["effective_share_95"] <= paper["share"]


def test_the_papers_dilated_network_reads_every_second_row_and_column():
    (row,) = measure_fields(["erf-posenet-dilated"], "paper", SNIPPET)
    read = row.seen.gradient > 0
    rows, columns = read.nonzero(as_tuple=True)
    assert (rows % 2 == 1).all() and (columns % 2 == 1).all()


@pytest.mark.parametrize(
    "name, side, columns, fraction",
    [("erf-posenet-dfc", 511, 415, 0.998), ("posenet", 263, 263, 0.632)],
)
def test_pushed_taps(name, side, columns, fraction):
    summary = by_name([name])[name, "default"]
    assert (summary["theoretical_px"], summary["theoretical_at_rest_px"]) == (side, 263)
    assert summary["offsets_px"] == (1.0 if "dfc" in name else 0.0)
    assert summary["columns"] == columns
    assert summary["share"] == pytest.approx(fraction, abs=6e-4)
