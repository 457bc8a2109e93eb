"""Time, threads and imports of heavy libraries."""
