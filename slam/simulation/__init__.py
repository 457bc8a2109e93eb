"""Simulated worlds, a street and a house: surfaces, textures, and what a camera sees of them."""
