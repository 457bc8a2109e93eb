"""Lengths of steps and their unit: ground plane, road homography, triangulated points."""
