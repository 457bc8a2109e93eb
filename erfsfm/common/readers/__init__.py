"""Readers of recordings on disk: images, videos, cameras and KITTI's files. NumPy and OpenCV, never torch.

What is missing, damaged or of another kind is a ``DataError`` of one line.
"""
