"""One run, from its arguments to the whole run folder."""
