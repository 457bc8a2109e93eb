"""Pose graphs of rigid transforms and of similarities."""
