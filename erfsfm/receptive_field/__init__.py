"""Receptive fields of the networks: measurement, figure, and a drawn street as input."""
