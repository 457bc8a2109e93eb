from pathlib import Path

import yaml

from slam.config.sections import SlamConfig, dump_yaml, load_config

DEFAULT = Path(__file__).parents[3] / "configs" / "slam" / "default.yaml"


def test_default_file_is_the_defaults_complete_and_explained():
    assert load_config(DEFAULT) == load_config("default") == load_config() == SlamConfig()
    assert DEFAULT.read_text() == dump_yaml(SlamConfig())
    assert yaml.safe_load(DEFAULT.read_text()).keys() == SlamConfig.model_fields.keys()
    assert "None" not in dump_yaml(SlamConfig())


def test_dump_reads_back(tmp_path):
    config = load_config(
        None, ["mapping.keyframe_distance_m=1e-4", "gps.correlation_s=7", "scale.mode=none"]
    )
    assert config.mapping.keyframe_distance_m == 1e-4
    assert config.gps.correlation_s == 7
    path = tmp_path / "mine.yaml"
    path.write_text(dump_yaml(config))
    assert load_config(path) == config


def test_file_may_be_partial_and_overrides_win(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("gps: {sigma_m: 2e0}\nmapping:\n  voxel_size_m: 1e-1\n")
    config = load_config(path, ["gps.sigma_m=3"])
    assert config.gps.sigma_m == 3.0
    assert config.mapping.voxel_size_m == 0.1
    path.write_text("")
    assert load_config(path) == SlamConfig()
