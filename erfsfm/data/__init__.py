"""Recordings on disk turned into training snippets, and the record of what was seen.

What is missing or malformed in a data set is a ``DataError`` of one line, from any function here.
"""
