"""Storage on disk: atomic files, the cache, serialised sessions and spilled arrays."""
