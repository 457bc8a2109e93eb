"""The system at work: one pass over all frames, frames as they come, and a session kept on disk."""
