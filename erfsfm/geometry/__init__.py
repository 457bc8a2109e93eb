"""Cameras, rigid transforms and the differentiable inverse warp."""
