from __future__ import annotations

from functools import partial

import numpy as np

from slam.frames import Intrinsics
from slam.mapping.filters import KeyframeDepth
from slam.results.depth import DepthQuality, projected, true_depth
from slam.sequences.images import read_depth_map
from slam.sequences.recording import RecordedSequence, Source

CAMERA = Intrinsics(8, 6, 5.0, 5.0, 3.5, 2.5)
DEPTH = np.full((6, 8), 5.0, np.float32)


def recorded(**more) -> RecordedSequence:
    images = type("Images", (), {"width": 8, "height": 6, "__len__": lambda self: 4})()
    return RecordedSequence("a", images, CAMERA, np.arange(4.0), (Source("a"),), **more)


def keyframe(refined: bool = True) -> KeyframeDepth:
    image = np.zeros((6, 8, 3), np.uint8)
    sigma = np.full_like(DEPTH, 0.1)
    sigma[0] = 0.3
    if not refined:
        return KeyframeDepth(2, DEPTH, None, image, np.eye(4))
    return KeyframeDepth(2, DEPTH * 1.1, sigma, image, np.eye(4), DEPTH)


def with_depth(tmp_path) -> RecordedSequence:
    import cv2

    path = tmp_path / "000002.png"
    cv2.imwrite(str(path), (DEPTH * 256).astype(np.uint16))
    return recorded(depth_maps={2: partial(read_depth_map, path)})


def test_stored_depth_is_read_and_compared(tmp_path) -> None:
    quality = DepthQuality(with_depth(tmp_path), is_metric=True)
    quality.add(keyframe())
    summary = quality.metrics(is_refined=True).tree()
    assert summary["network"]["abs_rel"] == 0
    assert abs(summary["refined"]["abs_rel"] - 0.1) < 1e-4
    assert summary["refined"]["coverage"].keys() == {"50", "90", "95"}


def test_an_excerpt_reads_the_frame_of_its_base(tmp_path) -> None:
    excerpt = with_depth(tmp_path).cut(2, 4)
    np.testing.assert_allclose(true_depth(excerpt, 0), DEPTH)
    assert true_depth(excerpt, 1) is None


def test_a_depth_map_that_cannot_be_read_is_left_out_with_one_warning(tmp_path, caplog) -> None:
    sequence = with_depth(tmp_path)
    (tmp_path / "000002.png").write_bytes(b"x")
    quality = DepthQuality(sequence, is_metric=True)
    for _ in range(2):
        quality.add(keyframe())
    assert quality.metrics(True).network.absent == "the true depth of 2 keyframes cannot be read"
    assert len(caplog.messages) == 1 and "000002.png" in caplog.messages[0]


def test_every_missing_number_has_its_reason(tmp_path) -> None:
    def reasons(metric: bool, sequence: RecordedSequence, *keyframes: KeyframeDepth, is_refined: bool = True):
        quality = DepthQuality(sequence, metric)
        for one in keyframes:
            quality.add(one)
        summary = quality.metrics(is_refined).tree()
        return summary.get("network_reason"), summary.get("refined_reason")

    known = with_depth(tmp_path)
    assert "mapping.enabled" in reasons(True, known)[0]
    assert "no true depth" in reasons(True, recorded(), keyframe())[1]
    assert "not in metres" in reasons(False, known, keyframe())[0]
    assert reasons(True, known, keyframe(False)) == (None, "no keyframe has a neighbour at a useful distance")
    assert reasons(True, known, keyframe(False), is_refined=False) == (None, "depth.refine is none")


def test_the_nearest_lidar_point_of_a_pixel_counts() -> None:
    depth = projected(np.array([[0.1, 0.1, 4.0], [0.2, 0.2, 8.0], [0, 0, -3.0]]), np.eye(4), CAMERA)
    assert depth[3, 4] == 4.0 and (depth > 0).sum() == 1
