"""The pipeline: batch runs over all frames, live sessions frame by frame, and their checkpoints on disk."""
