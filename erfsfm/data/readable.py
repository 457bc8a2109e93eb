"""The stretches of recordings that can be read: a file that cannot be read does not end a packing."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from erfsfm.common.errors import DataError
from erfsfm.config import NetworkConfig
from erfsfm.data.recordings import Recording

logger = logging.getLogger(__name__)


def readable_parts(recordings: Sequence[Recording], network: NetworkConfig) -> list[Recording]:
    """Parts of a snippet or more without an unreadable image, in order; one warning counts the images left out.

    Every image is decoded for this.

    Raises:
        DataError: no part is long enough.
    """
    parts: list[Recording] = []
    least = network.sources + 1
    reasons: list[str] = []
    for recording in recordings:
        ends = [-1]
        for index in range(len(recording)):
            try:
                recording.image(index, network.height, network.width)
            except DataError as error:
                reasons.append(str(error))
                ends.append(index)
        spans = zip([end + 1 for end in ends], [*ends[1:], len(recording)], strict=True)
        parts += [recording.part(start, stop) for start, stop in spans if stop - start >= least]
    if not reasons:
        return list(recordings)
    if not parts:
        raise DataError(f"no {least} consecutive images can be read: {reasons[0]}")
    total, kept = sum(map(len, recordings)), sum(map(len, parts))
    logger.warning(
        "%d of %d images cannot be read; %d are left out, with those of stretches shorter than a snippet: %s",
        len(reasons),
        total,
        total - kept,
        reasons[0],
    )
    return parts
