"""Storage on disk: atomic files, serialised sessions and spilled arrays."""
