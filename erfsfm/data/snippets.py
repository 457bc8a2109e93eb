"""Windows of consecutive frames with the target in the middle, as training samples; labels of simulated worlds.

Sample number i is a pure function of the seed and i: which recording, which window, which
augmentation. A run resumed at step k therefore draws the same samples as an uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import report_unreadable
from erfsfm.config import DataConfig, ExperimentConfig
from erfsfm.data.augmentation import as_tensors, in_heights, single_image, training_sample
from erfsfm.data.many_view_teacher import Learned, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.data.split import usable
from erfsfm.data.window import (
    ArrayCache,
    Snippet,
    TeacherStructure,
    first_readable,
    load_window,
    snippet_motion,
)

_VALIDATED = 40  # snippets: as many as the shipped weights were chosen by
# what the simulator leaves unknown is sky; of a depth camera it may be anywhere
FARTHEST_M = 200.0


class SnippetDraws(IterableDataset[dict[str, Tensor]]):
    """Random snippets number ``first_draw`` to ``draws``; whole batches are distributed to processes and workers."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        config: ExperimentConfig,
        draws: int,
        first_draw: int = 0,
        rank: int = 0,
        many_views: ManyViewTeacher | None = None,
        imitated: Learned | None = None,
    ) -> None:
        self._config = config
        self._draws = draws
        self._first_draw = first_draw
        self._rank = rank
        size = (config.network.height, config.network.width)
        depth_mb = (
            config.data.cache_mb // 5
            if config.data.exact > 0 or config.teacher.exact or imitated
            else 0
        )
        images_mb = (
            config.data.cache_mb - depth_mb - (0 if many_views is None else labels_mb(config.data))
        )
        self._cache = ArrayCache(images_mb, (*size, 3), np.uint8)
        self._depth = ArrayCache(
            depth_mb, size, np.float32
        )  # true depth, inverse depth that is imitated
        self._exact_labels = ExactLabels(self._depth)
        self._many_views, self._imitated = many_views, imitated
        length = config.network.sources + 1
        self.recordings = usable(recordings, length)
        # by their masks; empty where none has one
        has_mask = any(recording.mask for recording in self.recordings)
        self._fixed = {each.mask: each.fixed(*size) for each in self.recordings if has_mask}
        self._exact, self._measured = by_label(self.recordings, config)
        weights = config.data.weights
        names = list(dict.fromkeys(recording.name for recording in self.recordings))
        for prefix in weights:
            if not any(name.startswith(prefix) for name in names):
                raise DataError(f"data.weights names '{prefix}', but no recording starts with it")
        for name in names:
            if weights and not name.startswith(tuple(weights)):
                raise DataError(
                    f"data.weights gives '{name}' no weight: name it there, or leave its data set out"
                )
        self._probabilities = chances(
            self._measured, [len(one) - length + 1 for one in self._measured], weights
        )
        self._exact_probabilities = chances(
            self._exact, [1] * len(self._exact), weights
        )  # however long they are

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        worker = get_worker_info()
        index, count = (worker.id, worker.num_workers) if worker else (0, 1)
        batch, processes = self._config.training.batch, self._config.training.devices
        for number, first in enumerate(
            range(self._first_draw + self._rank * batch, self._draws, batch * processes)
        ):
            if number % count == index:
                yield from map(self.draw, range(first, min(first + batch, self._draws)))

    def draw(self, number: int) -> dict[str, Tensor]:
        """Sample ``number``, a `training_sample` of the first snippet drawn that can be read.

        The first samples of a batch are a `single_image` with exact depth each under ``data.exact``.
        """
        training = self._config.training
        rng = np.random.default_rng([training.seed, number])
        if self._exact and number % training.batch < training.of_batch(self._config.data.exact):
            recording = self._exact[int(rng.choice(len(self._exact), p=self._exact_probabilities))]
            index = int(rng.integers(len(recording)))
            bounds = self._exact_labels.bounds(recording, index)
            camera = recording.seen_by(self._config.network)
            (image,) = load_window(self._cache, Snippet(recording, index), 1)
            return single_image(image, camera, bounds, self._config, rng)
        snippet, images = first_readable(self._chosen(rng), self._images)
        camera = snippet.recording.seen_by(self._config.network)
        seen = self._known(snippet)
        if self._config.single_images:
            assert seen is not None, "there are labels"
            return single_image(images[0], camera, (seen.least, seen.most), self._config, rng)
        fixed = self._fixed.get(snippet.recording.mask)
        return training_sample(images, camera, seen, self._config, rng, fixed)

    def _images(self, snippet: Snippet) -> list[NDArray[np.uint8]]:
        """Those of a sample in time order: the snippet's, or its target alone."""
        sources = self._config.network.sources
        if self._config.single_images:
            return load_window(
                self._cache, Snippet(snippet.recording, snippet.first + sources // 2), 1
            )
        return load_window(self._cache, snippet, sources + 1)

    def _chosen(self, rng: np.random.Generator) -> Iterator[Snippet]:
        """Random snippets without end."""
        sources = self._config.network.sources
        while True:
            recording = self._measured[int(rng.choice(len(self._measured), p=self._probabilities))]
            starts = range(
                len(recording) - sources
            )  # first frames of the snippets that may be drawn
            if self._many_views is not None:
                targets = self._many_views.drive(recording).targets(sources)
                starts = range(
                    targets.start - sources // 2, targets.stop - sources // 2, targets.step
                )
            yield Snippet(recording, starts[int(rng.integers(len(starts)))])

    def _known(self, snippet: Snippet) -> TeacherStructure | None:
        """The label of a snippet, if there is a teacher, without what is fixed to the camera."""
        seen, fixed = self._structure(snippet), self._fixed.get(snippet.recording.mask)
        if seen is None or fixed is None:
            return seen
        least, most = np.where(fixed, 0, seen.least), np.where(fixed, np.inf, seen.most)
        return TeacherStructure(seen.T_source_target, least, most)

    def _structure(self, snippet: Snippet) -> TeacherStructure | None:
        """The label of a snippet, if there is a teacher."""
        recording, sources = snippet.recording, self._config.network.sources
        if self._imitated is not None:
            target = snippet.first + sources // 2
            bound = self._depth.get(
                (*recording.key, target), partial(self._by_imitated, recording, target)
            )
            return TeacherStructure(np.full((sources, 4, 4), np.nan, np.float32), bound, bound)
        if self._many_views is not None:
            return self._many_views.structure(recording, snippet.first, sources)
        return (
            self._exact_labels.structure(recording, snippet.first, sources)
            if self._config.teacher.exact
            else None
        )

    def _by_imitated(self, recording: Recording, index: int) -> NDArray[np.float32]:
        """Inverse depth in camera heights; of a file as it is stored, in which a network sees more."""
        assert self._imitated is not None, "a network is imitated"
        (height, width), stored = self._depth.shape, recording.camera
        # a video has all of its frames decoded at one size
        image = recording.image(
            index, *((stored.height, stored.width) if recording.video is None else (height, width))
        )
        inverse_depth = cv2.resize(
            self._imitated(image), (width, height), interpolation=cv2.INTER_AREA
        )
        return in_heights(
            np.asarray(inverse_depth), recording.seen_by(self._config.network), self._config
        )


class ValidationSnippets(Dataset[dict[str, Tensor]]):
    """The same evenly spaced snippets every time, with truth where the recordings have it.

    Beside the training tensors: ``depth`` ``(H, W)`` z-depth of the target at its stored size and
    ``T_source_target`` ``(N, 4, 4)``, each absent where unknown.
    """

    def __init__(self, recordings: Sequence[Recording], config: ExperimentConfig) -> None:
        self._network = config.network
        self._cache = ArrayCache(
            config.data.cache_mb, (self._network.height, self._network.width, 3), np.uint8
        )
        length = config.network.sources + 1
        windows = []
        for recording in usable(recordings, length):
            for first in range(len(recording) - length + 1):
                windows.append(Snippet(recording, first))
        chosen = np.linspace(0, len(windows) - 1, min(_VALIDATED, len(windows)))
        self.snippets: list[Snippet] = []
        reasons: list[str] = []
        for i in chosen.round():
            snippet = windows[int(i)]
            try:
                self._read(snippet)
                self.snippets.append(snippet)
            except DataError as error:
                reasons.append(str(error))
        report_unreadable(reasons, len(chosen), "snippets to validate on")

    def __len__(self) -> int:
        return len(self.snippets)

    def __getitem__(self, item: int) -> dict[str, Tensor]:
        snippet, network = self.snippets[item], self._network
        recording = snippet.recording
        images, depth = self._read(snippet)
        sample = as_tensors(images, recording.seen_by(network).K)
        if depth is not None:
            sample["depth"] = torch.from_numpy(depth)
        T_world_camera = recording.true_poses()
        if T_world_camera is not None:
            sample["T_source_target"] = torch.from_numpy(
                snippet_motion(T_world_camera, snippet.first, network.sources)
            )
        return sample

    def _read(self, snippet: Snippet) -> tuple[list[NDArray[np.uint8]], NDArray[np.float32] | None]:
        """Images in time order, and true depth of the target where it is known."""
        images = load_window(self._cache, snippet, self._network.sources + 1)
        return images, snippet.recording.true_depth(snippet.first + self._network.sources // 2)


def labels_mb(config: DataConfig) -> int:
    """The part of ``data.cache_mb`` for labels of many views: larger than images, but fewer."""
    return config.cache_mb * 2 // 5


def chances(
    recordings: Sequence[Recording], sizes: Sequence[int], weights: Mapping[str, float]
) -> NDArray[np.float64]:
    """Chance of each recording: by its size among those of its prefix, and by the weight of the prefix."""
    each = np.array(sizes, dtype=np.float64)
    total = np.zeros(len(recordings)) if weights else each
    for prefix, weight in weights.items():
        chosen = np.array(
            [recording.name.startswith(prefix) for recording in recordings], dtype=bool
        )
        if chosen.any():
            total += np.where(chosen, weight * each / each[chosen].sum(), 0)
    return np.asarray(total / total.sum()) if len(recordings) else total


class ExactLabels:
    """Labels of recordings with exact depth, in camera heights, of the size that the cache has them in."""

    def __init__(self, cache: ArrayCache) -> None:
        self._depth = cache
        self._poses: dict[tuple[str, Path], NDArray[np.float64] | None] = {}

    def bounds(
        self, recording: Recording, index: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Least and most inverse depth of a frame, each ``(H, W)``."""
        height_m = recording.camera_height_m
        assert height_m is not None, "recordings are exact"
        depth_m = self._depth.get(
            (*recording.key, index), partial(recording.shrunk_depth, index, *self._depth.shape)
        )
        seen = depth_m > 0
        beyond = height_m / FARTHEST_M if recording.name.startswith("simulated/") else np.inf
        most = np.where(seen, height_m / np.where(seen, depth_m, 1), beyond).astype(np.float32)
        return np.where(seen, most, 0).astype(np.float32), most

    def structure(self, recording: Recording, first: int, sources: int) -> TeacherStructure:
        """Of the snippet that begins at a frame; its motion is unknown where the recording has no poses."""
        if recording.key not in self._poses:
            self._poses[recording.key] = recording.true_poses()
        T_world_camera = self._poses[recording.key]
        T_source_target = np.full((sources, 4, 4), np.nan, np.float32)
        if T_world_camera is not None and recording.camera_height_m is not None:
            T_source_target = snippet_motion(T_world_camera, first, sources).astype(np.float32)
            T_source_target[:, :3, 3] /= recording.camera_height_m
        return TeacherStructure(T_source_target, *self.bounds(recording, first + sources // 2))


def by_label(
    recordings: Sequence[Recording], config: ExperimentConfig
) -> tuple[list[Recording], list[Recording]]:
    """The recordings of which single images with exact depth are drawn, and those of which snippets are.

    Raises:
        DataError: exact depth is wanted, and recordings lack it, or all have it and a mixture is
            wanted.
    """
    exact = [recording for recording in recordings if recording.exact]
    measured = [recording for recording in recordings if not recording.exact]
    if config.teacher.exact and measured:
        raise DataError(
            f"teacher.views=exact needs the true depth of every recording; {measured[0].name} has none: simulate with "
            "--depth, or label real drives by teacher.views=many"
        )
    if config.data.exact == 0:
        return [], list(recordings)
    if not exact or not measured:
        raise DataError(
            "data.exact mixes simulated worlds that have depth maps (erfsfm-slam simulate --depth) with other "
            f"recordings; found {len(exact)} and {len(measured)}"
        )
    return exact, measured


def stacked(samples: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """A batch: of every tensor those of the samples that have it, in order."""
    tensors: dict[str, list[Tensor]] = {}
    for sample in samples:
        for key, tensor in sample.items():
            tensors.setdefault(key, []).append(tensor)
    return {key: torch.stack(each) for key, each in tensors.items()}
