"""Training samples from shards, read one after the other: memory for one of them a data loader process.

Each loader process of each training process has a lane: every so many-th shard of an order that is drawn anew for
every pass over the data. Within a shard the snippets come in an order of their own. Sample number i is thus a pure
function of the seed, i, and the numbers of processes; a resumed run passes over what was drawn without reading it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig
from erfsfm.data.array_cache import ImageCache
from erfsfm.data.exact_depth import ExactImages, by_label
from erfsfm.data.many_view_teacher import motion_alone, snippet_motion
from erfsfm.data.recordings import Recording
from erfsfm.data.samples import single_image, training_sample
from erfsfm.data.shards import Clip, InShards
from erfsfm.data.snippets import chances, usable
from erfsfm.labels.structure import StructureCache, TeacherStructure

_ORDER, _WITHIN = 0, 1  # what is drawn for a pass over the data


class _Stretch(NamedTuple):
    """Snippets of one clip that may be drawn: they begin at the frames ``range(first, stop, step)``."""

    shard: int
    which: int
    clip: int
    first: int
    stop: int
    step: int


class ShardDraws(IterableDataset[dict[str, Tensor]]):
    """Snippets number ``first_draw`` to ``draws`` of recordings in shards; whole batches go to processes and workers.

    Under ``data.exact`` a batch begins with `ExactImages`, of worlds that are files.

    Raises:
        DataError: the shards do not fit the experiment, or are fewer than the loader processes.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        config: ExperimentConfig,
        draws: int,
        first_draw: int = 0,
        rank: int = 0,
    ) -> None:
        self._config = config
        self._draws = draws
        self._first_draw = first_draw
        self._rank = rank
        self._structures = StructureCache(config.teacher.cache)
        length = config.network.sources + 1
        self.recordings = usable(recordings, length)
        exact, self._packed = by_label(self.recordings, config.data)
        cache = ImageCache(config.data.cache_mb, config.network.height, config.network.width)
        self._exact = ExactImages(exact, config, cache) if exact else None
        self._exact_of_batch = config.training.of_batch(config.data.exact)
        self._places = [_place(recording, config) for recording in self._packed]
        self._packs = list(dict.fromkeys(place.shards for place in self._places))
        self._offsets = np.cumsum([0, *(pack.index.files for pack in self._packs)])
        self._stretches = self._find_stretches()
        self._weights, self._counts = self._weigh(chances(self._packed, length, config.data))
        self._filled = np.flatnonzero(self._counts)
        lanes = config.training.processes * max(config.data.workers, 1)
        if len(self._filled) < lanes:
            raise DataError(
                f"{len(self._filled)} shards are too few for {lanes} data loader processes, each of which reads its "
                "own: set data.workers lower, or pack again with a lower --shard-megabytes"
            )

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        index, workers = (worker.id, worker.num_workers) if worker else (0, 1)
        training = self._config.training
        together = training.batch * training.processes
        number = self._first_draw // together + index  # of a batch; the loader begins with worker 0 after a resume too
        lane = number % workers * training.processes + self._rank
        drawn = self._lane(
            lane, workers * training.processes, number // workers * (training.batch - self._exact_of_batch)
        )
        for batch in range(number, self._draws // together, workers):
            first = (batch * training.processes + self._rank) * training.batch
            for draw in range(first, first + training.batch):
                rng = np.random.default_rng([training.seed, draw])
                if self._exact is not None and draw - first < self._exact_of_batch:
                    yield self._exact.draw(rng)
                else:
                    yield self._sample(*next(drawn), rng)

    def _lane(self, lane: int, lanes: int, skip: int) -> Iterator[tuple[int, int, Clip]]:
        """Recording, first frame and clip of the snippets of a lane after the first ``skip``, without end."""
        seed, epoch = self._config.training.seed, 0
        while True:
            order = np.random.default_rng([seed, epoch, _ORDER]).permutation(self._filled)
            for shard in map(int, order[lane::lanes]):
                if skip < self._counts[shard]:
                    rng = np.random.default_rng([seed, epoch, _WITHIN, shard])
                    yield from self._within(shard, rng, skip)
                skip = max(skip - int(self._counts[shard]), 0)
            epoch += 1

    def _within(self, shard: int, rng: np.random.Generator, skip: int) -> Iterator[tuple[int, int, Clip]]:
        """The snippets of a shard: each once, or, by ``data.weights``, some again and some not at all."""
        here = self._stretches[np.searchsorted(self._stretches[:, 0], shard) :]
        stretches = [_Stretch(*map(int, row)) for row in here[: np.searchsorted(here[:, 0], shard, "right")]]
        snippets = [(s, first) for s in stretches for first in range(s.first, s.stop, s.step)]
        if self._config.data.weights:
            weights = self._weights[[stretch.which for stretch, _ in snippets]]
            order = rng.choice(len(snippets), int(self._counts[shard]), p=weights / weights.sum())
        else:
            order = rng.permutation(len(snippets))
        pack = int(np.searchsorted(self._offsets, shard, "right")) - 1
        file = shard - int(self._offsets[pack])
        clips = self._packs[pack].read(file)
        for choice in order[skip:]:
            stretch, first = snippets[choice]
            key = self._places[stretch.which].number, stretch.clip
            if key not in clips:
                raise DataError(
                    f"shard {file} of {self._packs[pack].pack} does not hold what its index says: copy it again"
                )
            yield stretch.which, first, clips[key]

    def _sample(self, which: int, first: int, clip: Clip, rng: np.random.Generator) -> dict[str, Tensor]:
        recording, sources = self._packed[which], self._config.network.sources
        if self._config.single_images:
            target = first + sources // 2
            return single_image(clip.image(target), recording.camera, clip.label(target), self._config, rng)
        images = [clip.image(frame) for frame in range(first, first + sources + 1)]
        seen = self._structure(clip, first, images, recording.camera.K)
        return training_sample(images, recording.camera, seen, (which, first - recording.start), self._config, rng)

    def _structure(
        self, clip: Clip, first: int, images: list[NDArray[np.uint8]], K: NDArray[np.float32]
    ) -> TeacherStructure | None:
        """What the teacher measured, if there is one."""
        config = self._config
        if config.teacher.views == "two":
            return self._structures.structure(images, K) if config.teacher.weights else None
        sources = config.network.sources
        T_source_target = snippet_motion(clip.T_world_camera, first - clip.first, sources)
        if config.training.networks == "pose":
            return motion_alone(T_source_target, images[0].shape[:2])
        return TeacherStructure(T_source_target, *clip.label(first + sources // 2))

    def _find_stretches(self) -> NDArray[np.int64]:
        """Rows of `_Stretch`, sorted by shard: where clips and recordings, perhaps parts of those packed, meet."""
        sources = self._config.network.sources
        labelled = self._config.teacher.views == "many" and self._config.training.networks != "pose"
        found = []
        for number, shards in enumerate(self._packs):
            clips = shards.clips()
            clips = clips[np.argsort(clips[:, 1], kind="stable")]
            step = shards.index.stride if labelled else 1
            for which, (recording, place) in enumerate(zip(self._packed, self._places)):
                if place.shards != shards:
                    continue
                begin, end = np.searchsorted(clips[:, 1], [place.number, place.number + 1])
                shard, _, first, frames = clips[begin:end].T
                start = np.maximum(first, recording.start)
                stop = np.minimum(first + frames, recording.start + len(recording)) - sources
                start = start + (place.begin - start - sources // 2) % step
                same = np.full_like(first, which)
                rows = np.stack([shard + self._offsets[number], same, first, start, stop, np.full_like(first, step)], 1)
                found.append(rows[start < stop])
        stretches = np.concatenate(found)
        return np.asarray(stretches[np.argsort(stretches[:, 0], kind="stable")])

    def _weigh(self, chance: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Chance of a snippet of each recording, and how many are drawn from each shard in a pass over the data.

        Under ``data.weights`` that is the shard's part of all weight, else the snippets it has.
        """
        shard, which, _, first, stop, step = self._stretches.T
        sizes = -(-(stop - first) // step)
        weights = chance / np.maximum(np.bincount(which, sizes, len(chance)), 1)
        if not self._config.data.weights:
            return weights, np.bincount(shard, sizes).astype(np.int64)
        shares = np.cumsum(np.bincount(shard, sizes * weights[which]))
        return weights, np.diff(np.rint(shares / shares[-1] * sizes.sum()), prepend=0).astype(np.int64)


def in_shards(training: Sequence[Recording], validation: Sequence[Recording]) -> bool:
    """Whether the recordings to train on lie in shards.

    Raises:
        DataError: some do and some do not, or those to validate on do.
    """
    for recording in validation:
        if recording.packed is not None:
            raise DataError(
                f"{recording.name} lies in shards, which are to train on: pack again with it in data.validation"
            )
    packed = [recording.packed is not None for recording in training]
    if any(packed) and not all(packed):
        raise DataError(
            f"{training[packed.index(False)].name} is not in shards as {training[packed.index(True)].name} is: "
            "pack it into shards too, or train on one kind of data set"
        )
    return any(packed)


def _place(recording: Recording, config: ExperimentConfig) -> InShards:
    """Where a recording lies, if its shards fit the experiment."""
    place, network, camera = recording.packed, config.network, recording.camera
    if place is None:
        raise DataError(f"{recording.name} is not in shards")
    index = place.shards.index
    if (index.sources, camera.height, camera.width) != (network.sources, network.height, network.width):
        raise DataError(
            f"the shards of {place.shards.pack} hold snippets of {index.sources + 1} images of {camera.width} x "
            f"{camera.height}, the experiment wants {network.sources + 1} of {network.width} x {network.height}: set "
            "network.sources, network.height and network.width, or pack again"
        )
    wanted = "poses" if config.training.networks == "pose" else "depth and poses"
    if config.teacher.views == "many" and index.teacher not in (wanted, "depth and poses"):
        raise DataError(
            f"the shards of {place.shards.pack} hold no labels of many views ({wanted}): pack again with "
            "teacher.views=many, or set teacher.views=two"
        )
    return place
