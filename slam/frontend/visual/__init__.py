"""Relative poses from optical flow: tracking, two-view geometry and their noise."""
