"""The map of a drive: depth maps fused into submaps on disk, submaps merged into one surface."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from erfsfm.common.progress import Progress, silent
from slam.config.sections import MappingConfig
from slam.formats.ply import Ply
from slam.frames import Intrinsics
from slam.mapping.depth import MOST_RELATIVE_SIGMA, DepthFilters, KeyframeDepth
from slam.mapping.submap import BLOCK_VOXELS, Fusion, SpilledSubmap, ViewChooser
from slam.mapping.surface import MapSurface
from slam.runtime.errors import EmptyMapError
from slam.runtime.memory import SpillFile

# of the memory: growing needs twice the blocks, and the rest of the map has its own
_FUSION_SHARE = 0.25
_BLOCK_MB = BLOCK_VOXELS * 8 / 2**20
_SUBMAP_LENGTH = 3.0  # largest depths after which a submap ends: 60 m of a street
_EARLIER = 3  # views between one and that which tells what has come since


class TsdfMap:
    """TSDF fusion of depth maps along a trajectory; lengths are in the trajectory's unit."""

    def __init__(self, config: MappingConfig, intrinsics: Intrinsics) -> None:
        """Prepare for depth maps and images of these ``intrinsics``."""
        self._config = config
        self._intrinsics = intrinsics
        self._filters = DepthFilters(config, intrinsics)
        self._views = ViewChooser(self._filters, config.depth_max_m)
        self._spill = SpillFile("the map")
        self._finished: list[SpilledSubmap] = []
        self._growing: Fusion | None = None
        self._before: deque[KeyframeDepth] = deque(maxlen=_EARLIER)
        self._waiting: KeyframeDepth | None = None
        self._fused = self._left_out = 0
        self._surface: MapSurface | None = None

    def integrate(self, keyframe: KeyframeDepth) -> None:
        """Take a depth map, and fuse the one before it, filtered by its neighbours.

        One without any depth that is certain enough is left out.

        Raises:
            SlamError: the disk is full.
        """
        depth = keyframe.depth
        known_depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0)).astype(
            np.float32
        )
        view = replace(keyframe, depth=known_depth, network_depth=None)
        if not self._filters.trusted(view).any():
            self._left_out += 1
            return
        self._fuse_waiting(view)
        self._waiting = view

    def surface(self, progress: Progress = silent) -> MapSurface:
        """The surface of all that was fused; more depth maps may follow.

        Raises:
            EmptyMapError: nothing was fused or seen often enough.
            SlamError: the disk is full.
        """
        self._fuse_waiting(None)
        if self._left_out and not self._before:
            raise EmptyMapError(
                f"the map is empty: none of {self._left_out} keyframes has depth whose relative sigma is at most "
                f"{MOST_RELATIVE_SIGMA:g}; more would be what networks guess"
            )
        if self._surface is None:
            self._finish_submap()
            self._surface = MapSurface(self._finished, self._config, self._intrinsics, progress)
        return self._surface

    def cloud(self) -> Ply:
        """The whole surface as points, in memory; raises as ``surface``."""
        return Ply(np.concatenate(list(self.surface().cloud_pieces())))

    @property
    def voxel_size(self) -> float:
        """Side of a voxel, in the trajectory's unit."""
        return self._config.voxel_size_m

    def statistics(self) -> dict[str, Any]:
        """Sizes of all that was given so far, zero for an empty map, and the share of pixels that each filter took."""
        self._fuse_waiting(None)
        sizes = {
            "triangles": 0,
            "points": 0,
            "blocks": 0,
            "submaps": len(self._finished),
            "floater_share": 0.0,
        }
        with suppress(EmptyMapError):
            surface = self.surface()
            sizes = {name: getattr(surface, name) for name in sizes}
        frames = {"frames_fused": self._fused, "frames_left_out": self._left_out}
        return sizes | frames | {"voxel_size": self.voxel_size, "filters": self._filters.shares()}

    def _fuse_waiting(self, following: KeyframeDepth | None) -> None:
        """Filter and fuse the view that waits for the one after it; a submap long or large enough ends with it."""
        if self._waiting is None:
            return
        view, self._waiting, config = self._waiting, None, self._config
        others = [*list(self._before)[-1:], *([] if following is None else [following])]
        kept = self._filters.kept(view, others, next(iter(self._before), None))
        self._before.append(view)
        if self._growing is None:
            self._growing = Fusion(config.voxel_size_m, config.reach_m, self._intrinsics)
        if not self._growing.integrate(kept, view.T_world_camera):
            return
        self._views.add(view, kept)
        self._fused += 1
        self._surface = None
        is_large = self._growing.blocks * _BLOCK_MB >= _FUSION_SHARE * config.memory_mb
        if is_large or self._growing.length >= _SUBMAP_LENGTH * config.depth_max_m:
            self._finish_submap()

    def _finish_submap(self) -> None:
        """Spill the submap that grows, if there is one."""
        if self._growing is None or not self._growing.blocks:
            return
        fields = self._growing.observed() | self._views.take()
        self._finished.append({name: self._spill.put(values) for name, values in fields.items()})
        self._growing = None
