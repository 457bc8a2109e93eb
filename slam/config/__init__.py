"""Frozen settings, their YAML files and overrides."""
