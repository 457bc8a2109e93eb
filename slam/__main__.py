"""Run the command line as ``python -m slam``."""

from slam.commands.cli import main

if __name__ == "__main__":
    main()
