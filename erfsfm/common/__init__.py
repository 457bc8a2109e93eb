"""Code of both packages without PyTorch: files, locks, YAML, errors, signals, threads, the command line, readers."""
