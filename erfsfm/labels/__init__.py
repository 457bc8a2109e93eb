"""Pseudo-labels of depth and motion, measured in the training images by two or many views."""
