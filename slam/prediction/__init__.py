"""Predictors of depth and snippet poses: the networks, optionally cached, and an oracle for tests."""
