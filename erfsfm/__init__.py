"""Self-supervised depth and ego-motion networks with wide receptive fields (ERF-SfMLearner)."""

__version__ = "0.1.0"

DISTRIBUTION = "erfsfm-slam"
