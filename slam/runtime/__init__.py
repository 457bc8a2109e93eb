"""Time, threads, progress bars and imports of heavy libraries."""
