"""The pipeline: batch runs over all frames and live sessions frame by frame."""
