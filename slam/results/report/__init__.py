"""The report of a run: its page, tables, figures, pictures and the map."""
