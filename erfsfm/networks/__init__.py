"""Depth and pose networks with wide receptive fields."""
