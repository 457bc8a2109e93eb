from pathlib import Path

import pytest
import yaml

from slam.config.sections import SlamConfig, dump_yaml, load_config
from slam.runtime.errors import ConfigError

DEFAULT = Path(__file__).parents[3] / "configs" / "slam" / "default.yaml"


def test_default_file_is_the_defaults_complete_and_explained():
    assert load_config(DEFAULT) == load_config("default") == load_config() == SlamConfig()
    assert DEFAULT.read_text() == dump_yaml(SlamConfig())
    assert yaml.safe_load(DEFAULT.read_text()).keys() == SlamConfig.model_fields.keys()
    assert "None" not in dump_yaml(SlamConfig())


def test_dump_reads_back(tmp_path):
    config = load_config(None, ["pose_graph.max_loop_residual=1e-4", "gps.correlation_s=7", "scale.mode=none"])
    assert config.pose_graph.max_loop_residual == 1e-4
    assert config.gps.correlation_s == 7
    path = tmp_path / "mine.yaml"
    path.write_text(dump_yaml(config))
    assert load_config(path) == config


def test_file_may_be_partial_and_overrides_win(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("pose_graph: {huber_k: 2e0}\nmapping:\n  voxel_size_m: 1e-1\n")
    config = load_config(path, ["pose_graph.huber_k=3"])
    assert config.pose_graph.huber_k == 3.0
    assert config.mapping.voxel_size_m == 0.1
    path.write_text("")
    assert load_config(path) == SlamConfig()


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("huber_k=1", ["huber_k", "did you mean 'pose_graph.huber_k'"]),
        ("pose_graph.huber_k=-1", ["pose_graph.huber_k", "greater than 0", "-1"]),
        ("pose_graph.huber_k=.nan", ["pose_graph.huber_k", "nan"]),
        ("scale.mode=metric", ["scale.mode", "camera-height", "metric"]),
        ("mapping.enabled=maybe", ["mapping.enabled", "boolean", "maybe"]),
        ("depth.source=onnx", ["depth.source", "onnx:FILE, npy:FOLDER or png:FOLDER", "'onnx'"]),
        ("depth.std=[0.2, 0, 0.2]", ["depth.std", "three numbers above 0"]),
        ("depth.mean=0.5", ["depth.mean", "tuple"]),
        ("mapping.depth_min_m=30", ["mapping", "depth_min_m < depth_max_m"]),
    ],
)
def test_wrong_override_is_one_clear_line(override, parts):
    with pytest.raises(ConfigError) as caught:
        load_config(None, [override])
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize("text", ["[" * 3000, "a: &a [*a]"])
def test_an_endless_file_is_one_line(tmp_path, text):
    path = tmp_path / "endless.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"endless\.yaml is not YAML") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)
