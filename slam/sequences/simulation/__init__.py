"""The parts of the simulated street world: pure NumPy, no ray casting."""
