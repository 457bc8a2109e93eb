"""What both packages use, without PyTorch: files, locks, YAML, errors, signals, threads, the command line, readers."""
