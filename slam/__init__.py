"""Monocular SLAM on learned depth and ego-motion: from frames to trajectory and map."""

DISTRIBUTION = "erfsfm-slam"
