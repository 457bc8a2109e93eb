"""The dense map: learned depth fused into submaps, which are merged into one surface."""
