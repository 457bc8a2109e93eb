"""Predictors of depth and snippet poses: the networks, optionally cached, and depth from elsewhere."""
