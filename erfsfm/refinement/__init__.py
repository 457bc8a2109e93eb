"""Learned depth refined by neighbouring images at known poses, without torch."""
