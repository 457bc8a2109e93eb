import pytest

from erfsfm.checkpoint import Model, build_networks
from erfsfm.config import NetworkConfig
from erfsfm.model_record import ModelRecord
from erfsfm.receptive_field.measure import measure_fields
from erfsfm.receptive_field.street import street_snippet

SNIPPET = street_snippet(5, 128, 416)


def by_name(names, **options):
    return {
        (row.name, row.fidelity): row
        for row in measure_fields(names, options.pop("fidelity", "default"), SNIPPET, **options)
    }


def test_the_papers_dilated_network_follows_ours():
    rows = by_name(["posenet", "erf-posenet-dilated"])
    assert list(rows) == [("posenet", "default"), ("erf-posenet-dilated", "default"), ("erf-posenet-dilated", "paper")]
    paper, ours = rows["erf-posenet-dilated", "paper"].summary(), rows["erf-posenet-dilated", "default"].summary()
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
    "name, side, columns, fraction", [("erf-posenet-dfc", 511, 415, 0.998), ("posenet", 263, 263, 0.632)]
)
def test_pushed_taps(name, side, columns, fraction):
    summary = by_name([name])[name, "default"].summary()
    assert (summary["theoretical_px"], summary["theoretical_at_rest_px"]) == (side, 263)
    assert summary["offsets_px"] == (1.0 if "dfc" in name else 0.0)
    assert summary["columns"] == columns
    assert summary["share"] == pytest.approx(fraction, abs=6e-4)


@pytest.mark.parametrize("sources", [2, 4])
def test_learned_weights_are_used_for_their_own_preset_alone(sources):
    config = NetworkConfig(pose="erf-posenet-dfc", depth_width=0.1, pose_width=0.1, sources=sources)
    model = Model(ModelRecord(network=config, trained_on=[]), *build_networks(config))
    rows = by_name(["depthnet", "posenet", "erf-posenet-dfc"], learned=("mine", model))
    assert [row.weights for row in rows.values()] == ["mine", "untrained", "mine"]
    before = rows["erf-posenet-dfc", "default"].weighed.gradient
    for parameter in model.pose_net.encoder.parameters():
        parameter.data.mul_(0.9).add_(0.01)
    after = by_name(["erf-posenet-dfc"], learned=("mine", model))["erf-posenet-dfc", "default"].weighed.gradient
    assert not before.equal(after)
