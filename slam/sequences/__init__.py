"""Sequences of frames: recordings on disk and the simulated street; ``catalogue`` opens them.

What a user can mend in a recording is a ``SequenceError`` or a ``DataError`` of one line, from any function here.
"""
