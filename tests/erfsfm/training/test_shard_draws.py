"""Training from shards: what is drawn by whom, what it holds, and what a damaged shard says."""

from __future__ import annotations

import functools
import http.server
import io
import pickle
import shutil
import tarfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from erfsfm.checkpoint import load_model
from erfsfm.common.errors import ConfigError, DataError
from erfsfm.config import ExperimentConfig
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.shard_draws import ShardDraws, in_shards
from erfsfm.data.snippets import SnippetDraws, split_recordings
from erfsfm.training.pack import pack
from erfsfm.training.run import train

Small = dict[str, dict[str, Any]]
SIZE, STRIDE = (32, 64), 3
FRAMES = {"simulated/0": 40, "simulated/1": 75, "simulated/2": 110, "kitti_odometry/00": 45}  # clips are of 32 and 2


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shards")


@pytest.fixture
def config(
    small: Small, shared: Path, write_root: Callable[..., Path], measure: Callable[..., None]
) -> ExperimentConfig:
    """Of a training on three worlds and a real drive, whose labels of many views are measured."""
    for name, frames in FRAMES.items():
        seed = int(name[-1]) if name.startswith("simulated") else None
        if not (shared / name).exists():
            write_root(shared / name, frames=frames, seed=seed, step=(0.0, 0.0, 0.02))
    if not (shared / "held_out").exists():
        write_root(shared / "held_out", frames=9, seed=500, depth=True)
    roots = [shared / name for name in (*FRAMES, "held_out")]
    data = {"roots": roots, "validation": ["simulated/500"], "validation_snippets": 3, "exclude": []}
    teacher = {"views": "many", "stride": STRIDE, "structure_weight": 1.0, "translation_weight": 1.0}
    tree = small | {
        "data": small["data"] | data | {"flip": 0.0, "zoom": 1.0},
        "teacher": teacher | {"cache": shared / "measured"},
        "loss": {"photometric_weight": 0.0},
    }
    config = ExperimentConfig.model_validate(tree)
    if not (shared / "measured").exists():
        measure(config, lambda _, target: (2 + target) / 200)
    return config


@pytest.fixture
def packed(config: ExperimentConfig, shared: Path) -> Path:
    """Its shards, of a few clips each."""
    output = shared / "pack"
    if not output.exists():
        pack(config, output, megabytes=0.15, quality=95)
    return output


def changed(config: ExperimentConfig, **sections: dict[str, Any]) -> ExperimentConfig:
    parts = {name: getattr(config, name).model_copy(update=update) for name, update in sections.items()}
    return config.model_copy(update=parts)


def on_pack(config: ExperimentConfig, *packs: Path, **data: Any) -> ExperimentConfig:
    return changed(config, data={"roots": list(packs), **data}, teacher={"cache": None})


def photometric(config: ExperimentConfig, **data: Any) -> ExperimentConfig:
    """Without a teacher: every window is a snippet."""
    plain = {"views": "two", "structure_weight": 0.0, "translation_weight": 0.0}
    return changed(config, teacher=plain, loss={"photometric_weight": 1.0}, data=data)


def draws(config: ExperimentConfig, number: int, first: int = 0, rank: int = 0) -> ShardDraws:
    return ShardDraws(split_recordings(config.data)[0], config, number, first, rank)


def frames(samples: Iterator[dict[str, Tensor]] | ShardDraws | DataLoader[dict[str, Tensor]]) -> list[tuple[int, ...]]:
    """Which images each sample is of, in the order drawn."""
    return [tuple(row.tolist()) for sample in samples for row in torch.atleast_2d(sample["frames"])]


def snippets_of(config: ExperimentConfig) -> int:
    """How many snippets there are, each once."""
    return sum(len(recording) - config.network.sources for recording in split_recordings(config.data)[0])


def test_every_snippet_comes_once_a_pass_in_an_order_of_the_seed(config: ExperimentConfig, packed: Path) -> None:
    config = photometric(on_pack(config, packed))
    total = snippets_of(config)
    assert total == sum(FRAMES.values()) - 2 * len(FRAMES)
    seen = frames(draws(config, 2 * total))
    assert set(Counter(seen[:total]).values()) == {1} and len(seen[:total]) == total
    assert set(seen[total:]) == set(seen[:total]) and seen[total:] != seen[:total]
    assert seen == frames(draws(config, 2 * total))
    other = frames(draws(changed(config, training={"seed": 1}), total))
    assert set(other) == set(seen) and other != seen[:total]


@pytest.mark.parametrize(("nodes", "workers"), [(2, 0), (2, 2), (1, 2)])
def test_processes_and_workers_share_a_pass_without_overlap(
    config: ExperimentConfig, packed: Path, nodes: int, workers: int
) -> None:
    config = changed(photometric(on_pack(config, packed, workers=workers)), training={"nodes": nodes, "batch": 2})
    total = snippets_of(config)
    part = total // 2 // (2 * nodes) * 2 * nodes  # lanes are of unequal length: none reaches its second pass

    def drawn(rank: int, first: int = 0) -> list[tuple[int, ...]]:
        return frames(DataLoader(draws(config, part, first, rank), 2, num_workers=workers))

    seen = [drawn(rank) for rank in range(nodes)]
    assert len({each for rank in seen for each in rank}) == part
    done = 5 * 2 * nodes  # after five steps
    assert [drawn(rank, done) for rank in range(nodes)] == [each[10:] for each in seen], "a resume goes on"


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_samples_are_those_of_the_originals(config: ExperimentConfig, packed: Path, weight: float) -> None:
    """The motion that warps the images is there without a term of the teacher, too."""
    weights = dict.fromkeys(("structure_weight", "translation_weight"), weight)
    config = config.model_copy(update={"teacher": config.teacher.model_copy(update=weights)})
    on_shards = on_pack(config, packed)
    assert in_shards(*split_recordings(on_shards.data))
    assert config.teacher.cache is not None
    teacher = ManyViewTeacher(config.teacher.cache, SIZE, STRIDE)
    originals = SnippetDraws(split_recordings(config.data)[0], config, 400, many_views=teacher)
    by_frames = {tuple(sample["frames"].tolist()): sample for sample in originals}
    compared = 0
    for sample in draws(on_shards, 60):
        one = by_frames.get(tuple(sample["frames"].tolist()))
        if one is None:
            continue
        compared += 1
        assert (sample["target"].float() - one["target"].float()).abs().mean() < 7.5
        assert (sample["sources"].float() - one["sources"].float()).abs().mean() < 7.5
        torch.testing.assert_close(sample["K"], one["K"])
        torch.testing.assert_close(sample["T_source_target"], one["T_source_target"])
        for bound in ("least", "most"):
            torch.testing.assert_close(sample[bound], one[bound], atol=0, rtol=0.03)
    assert compared > 40


def test_ranges_weights_and_several_packs_choose_among_the_shards(
    config: ExperimentConfig, packed: Path, shared: Path
) -> None:
    part = photometric(on_pack(config, packed, ranges={"simulated/2": "50:90"}, exclude=["simulated/0", "simulated/1"]))
    recordings = split_recordings(part.data)[0]
    names = sorted(recording.frames_name for recording in recordings)
    assert names == ["kitti_odometry/00[0:45]", "simulated/2[50:90]"]
    total = snippets_of(part)
    assert set(Counter(frames(draws(part, total))).values()) == {1}
    heavy = photometric(on_pack(config, packed, weights={"simulated": 1.0, "kitti": 9.0}))
    which = [name.startswith("kitti") for name in (r.name for r in split_recordings(heavy.data)[0])]
    share = np.mean([which[row[0] // 20_000_000] for row in frames(draws(heavy, snippets_of(heavy)))])
    assert share == pytest.approx(0.9, abs=0.05), "of the samples; 0.17 of the frames"
    second = shared / "second"
    if not second.exists():
        alone = photometric(changed(config, data={"roots": [shared / "simulated/1"], "validation": []}))
        pack(alone, second, megabytes=0.15)
    both = photometric(on_pack(config, packed, second))
    assert set(Counter(frames(draws(both, snippets_of(both)))).values()) == {1}


def test_it_trains_with_the_same_record_and_resumes_to_the_same_weights(
    config: ExperimentConfig, packed: Path, tmp_path: Path
) -> None:
    on_shards = on_pack(config, packed)
    before = sorted(packed.rglob("*"))
    record = load_model(train(on_shards, tmp_path / "whole", device="cpu")).record
    assert record.trained_on == ["simulated/0-2", "kitti_odometry/00[0:45]"]
    assert record.metrics.keys() >= {"abs_rel", "photometric"}
    train(changed(on_shards, training={"steps": 2}), tmp_path / "cut", device="cpu")
    train(on_shards, tmp_path / "cut", resume=True, device="cpu")
    whole, cut = (load_model(tmp_path / name / "last") for name in ("whole", "cut"))
    for one, other in zip(whole.depth_net.state_dict().values(), cut.depth_net.state_dict().values(), strict=True):
        assert torch.equal(one, other)
    assert sorted(packed.rglob("*")) == before, "nothing is measured anew"


@pytest.mark.slow
def test_two_nodes_train_on_different_shards(
    config: ExperimentConfig, packed: Path, tmp_path: Path, in_processes: Callable[..., None]
) -> None:
    """Were their samples the same, so would be the mean of their gradients, and the weights of one."""
    on_shards = on_pack(config, packed, workers=1)
    in_processes(changed(on_shards, training={"nodes": 2}), tmp_path / "two")
    train(on_shards, tmp_path / "one", device="cpu")
    one, two = (load_model(tmp_path / name / "last") for name in ("one", "two"))
    assert one.record.trained_on == two.record.trained_on and two.record.step == 4
    weights = zip(one.depth_net.parameters(), two.depth_net.parameters(), strict=True)
    assert not all(torch.equal(a, b) for a, b in weights)


@pytest.fixture
def server(packed: Path) -> Iterator[str]:
    """The address of the shards' folder."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(packed / "shards"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{served.server_address[1]}"
        served.shutdown()


def moved(packed: Path, folder: Path, address: str) -> Path:
    """The pack without its shards, which are at an address."""
    shutil.copytree(packed, folder, ignore=shutil.ignore_patterns("shards"))
    index = folder / "pack.yaml"
    index.write_text(index.read_text().replace("address: shards", f"address: {address}"))
    return folder


def test_shards_may_be_far_away(config: ExperimentConfig, packed: Path, server: str, tmp_path: Path) -> None:
    far = on_pack(config, moved(packed, tmp_path / "far", server))
    assert frames(draws(far, 50)) == frames(draws(on_pack(config, packed), 50))
    nowhere = on_pack(config, moved(packed, tmp_path / "nowhere", f"{server}/elsewhere"))
    with pytest.raises(DataError, match="404: File not found; is the address") as caught:
        frames(draws(nowhere, 2))
    assert "\n" not in str(caught.value)


def rewrite(shard: Path, change: Callable[[str, bytes], bytes]) -> None:
    """The same tar file with other content."""
    with tarfile.open(shard) as tar:
        members = [(each, tar.extractfile(each)) for each in tar.getmembers()]
        contents = [(each.name, file.read()) for each, file in members if file is not None]
    with tarfile.open(shard, "w") as tar:
        for name, data in contents:
            info = tarfile.TarInfo(name)
            info.size = len(changed_data := change(name, data))
            tar.addfile(info, io.BytesIO(changed_data))


class Shell:
    """A pickle that runs code."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return eval, ("open('executed', 'w')",)


def test_nothing_in_a_shard_is_executed(
    config: ExperimentConfig, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    buffer = io.BytesIO()
    np.save(buffer, np.array([Shell()], dtype=object), allow_pickle=True)
    for number, bad in enumerate((pickle.dumps(Shell()), buffer.getvalue())):
        hostile = shutil.copytree(packed, tmp_path / f"hostile{number}")
        for shard in (hostile / "shards").iterdir():
            rewrite(shard, lambda name, data: bad if name.endswith(".npy") else data)  # noqa: B023
        with pytest.raises(DataError, match="the poses are damaged"):
            frames(draws(on_pack(config, hostile), 4))
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda shard: shard.unlink(), r"\.tar cannot be read \(No such file or directory\): copy the pack again"),
        (lambda shard: shard.write_bytes(b"no tar" * 500), r"\.tar is damaged \(ReadError\): copy it again"),
        (lambda shard: shard.write_bytes(shard.read_bytes()[:6000]), r"\.tar is damaged"),
        (lambda shard: shard.write_bytes(bytes(10240)), "does not hold what its index says"),
        (lambda shard: shard.write_bytes(bytes(200_000)), "larger than|File too large"),
        (lambda shard: rewrite(shard, lambda name, data: data[:200]), "frame .* is (truncated|incomplete|no|damaged)"),
    ],
)
def test_a_damaged_shard_is_one_line(
    config: ExperimentConfig, packed: Path, tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    broken = shutil.copytree(packed, tmp_path / "broken")
    for shard in (broken / "shards").iterdir():
        damage(shard)
    with pytest.raises(DataError, match=message) as caught:
        frames(draws(on_pack(config, broken), 8))
    assert "\n" not in str(caught.value)


def test_what_does_not_fit_is_refused(config: ExperimentConfig, packed: Path, shared: Path, tmp_path: Path) -> None:
    on_shards = on_pack(config, packed)
    with pytest.raises(DataError, match="hold snippets of 3 images of 64 x 32, the experiment wants 3 of 96 x 32"):
        draws(changed(on_shards, network={"width": 96}), 2)
    with pytest.raises(DataError, match="too few for 99 data loader processes"):
        draws(changed(on_shards, data={"workers": 99}), 2)
    with pytest.raises(DataError, match="not in shards as simulated/0 is"):
        in_shards(*split_recordings(on_pack(config, packed, shared / "simulated/1").data))
    with pytest.raises(DataError, match="lies in shards, which are to train on: pack again"):
        train(on_pack(config, packed, validation=["simulated/1", "simulated/500"]), tmp_path / "run", device="cpu")
    plain = pack(photometric(config), tmp_path / "plain", megabytes=0.3)
    assert plain.labels == 0 and plain.frames == sum(FRAMES.values())
    with pytest.raises(DataError, match="hold no labels of many views"):
        draws(on_pack(config, tmp_path / "plain"), 2)
    with pytest.raises(DataError, match="raise --shard-megabytes"):
        pack(config, tmp_path / "tiny", megabytes=0.01)
    with pytest.raises(DataError, match="lies in shards, which are to train on alone"):
        pack(photometric(on_shards), tmp_path / "again")
    with pytest.raises(ConfigError, match="is not empty"):
        pack(config, packed)
    assert not (tmp_path / "tiny").exists()
