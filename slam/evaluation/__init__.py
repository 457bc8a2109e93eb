"""Errors of trajectories, of stated noise and of maps against the truth."""
