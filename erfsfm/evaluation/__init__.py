"""Depth and pose metrics in the protocols of the papers.

What is missing or malformed in a data set, or leaks, is a ``DataError`` of one line, from any function here.
"""
