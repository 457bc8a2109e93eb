"""Time, errors and imports of heavy libraries."""
