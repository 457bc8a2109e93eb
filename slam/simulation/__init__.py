"""The simulated street world: plan, surfaces, textures, traffic, LiDAR, and the sequence rendered from it."""
