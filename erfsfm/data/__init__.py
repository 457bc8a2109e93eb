"""Recordings on disk turned into training snippets, and the record of what was seen."""
