"""Run folders: their files, report, tables and figures; a file that is damaged is a ``RunError`` of one line."""
