"""New images located in the map of an old run."""
