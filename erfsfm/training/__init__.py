"""The objective, the Lightning module and the run around it."""
