"""Rigid transforms, robust statistics, camera poses from points, the earth."""
