"""Sequences of frames: recordings on disk and the simulated street; ``catalogue`` opens them."""
