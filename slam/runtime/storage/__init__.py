"""Storage on disk: atomic files and spilled arrays."""
