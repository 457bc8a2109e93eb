"""Errors of the map of true depth at true poses: what fusion, filters and cleaning lose by themselves.

Example: python tools/map_of_truth.py --dataset world --set mapping.voxel_size_m=0.1
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from shared.command import one_line_errors, parser_of

from slam.config.sections import load_config
from slam.evaluation.map import PlacedMetrics, compare, placed_metrics
from slam.mapping.filters import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.results.error_columns import written
from slam.results.map_error import HasTrueDepth
from slam.results.map_error import find_truth as surface_of
from slam.runtime.errors import SlamError
from slam.sequences.catalogue import open_sequence


@one_line_errors()
def main() -> None:
    """Fuse every true depth map of a data set, and compare the surface with the truth."""
    parser = parser_of(__doc__)
    parser.add_argument("--dataset", type=Path, help="with true poses and depth maps; default: the embedded sequence")
    parser.add_argument("--sequence")
    parser.add_argument("--set", nargs="+", default=(), metavar="KEY=VALUE", help="changes to the configuration")
    arguments = parser.parse_args()
    print(errors(arguments.dataset, arguments.sequence, arguments.set))


def errors(dataset: Path | None, name: str | None, overrides: list[str]) -> str:
    """One line of errors of the map."""
    config, sequence = load_config(None, overrides).mapping, open_sequence(dataset, name)
    truth = surface_of(sequence)
    if isinstance(truth, str) or sequence.reference is None or not isinstance(sequence, HasTrueDepth):
        raise SlamError(f"true poses and depth maps are wanted: {truth if isinstance(truth, str) else truth.name}")
    intrinsics = sequence.intrinsics
    exact = np.zeros((intrinsics.height, intrinsics.width), np.float32)
    tsdf_map = TsdfMap(config, intrinsics)
    frames = [int(frame) for frame in truth.frames]
    for frame in (frames[k] for k in tsdf_map.select(frames, sequence.reference)):
        size = intrinsics.width, intrinsics.height
        depth = cv2.resize(sequence.true_depth(frame).astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
        image = cv2.resize(sequence.frame(frame).image, size, interpolation=cv2.INTER_AREA)
        tsdf_map.integrate(KeyframeDepth(frame, depth, exact, image, sequence.reference[frame]))
    found = compare(truth, sequence.reference, {"map": tsdf_map.cloud().points})
    errors = placed_metrics(PlacedMetrics, found.distances["map"])
    score = written(errors.f_score.m02, 2), written(errors.f_score.m05, 2)
    return (
        f"accuracy {written(errors.accuracy_median_m, 3)} m, 90 % {written(errors.accuracy_90_m, 2)} m, "
        f"completeness {written(errors.completeness, 3)}, F-score {' / '.join(score)}"
    )


if __name__ == "__main__":
    main()
