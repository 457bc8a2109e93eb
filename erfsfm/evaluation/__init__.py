"""Depth and pose metrics in the protocols of the papers."""
