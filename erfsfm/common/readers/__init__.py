"""Readers of recordings on disk: images, videos, cameras and KITTI's files. NumPy and OpenCV, never torch."""
