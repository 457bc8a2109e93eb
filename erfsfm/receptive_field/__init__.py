"""Receptive fields of the networks: measurement, figure, and a synthetic street as input."""
