"""The parts of the simulated street world: plan, town, drive, textures, hazards and LiDAR."""
