"""Run folders: their files, report, tables, figures and exports."""
