"""Rigid transforms, robust statistics, camera poses from points, points from cameras, the earth."""
