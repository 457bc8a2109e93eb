"""A run folder and everything that is written to it or made from it."""
