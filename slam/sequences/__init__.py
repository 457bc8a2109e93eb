"""Where frames come from: recordings on disk and the simulated street; ``catalogue`` is the door."""
