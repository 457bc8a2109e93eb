"""Self-supervised depth and ego-motion networks with wide receptive fields (ERF-SfMLearner)."""

import os

__version__ = "0.1.0"

DISTRIBUTION = "erfsfm-slam"

# ONNX Runtime reports what it does to its maker unless it is told not to before it is loaded
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
# OpenCV compares the header of every image, before its pixels, with what it finds here as it is loaded
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))
