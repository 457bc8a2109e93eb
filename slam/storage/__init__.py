"""What is kept on disk: atomic files, the cache, sessions, and arrays spilled out of memory."""
