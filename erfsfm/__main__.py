"""Run the command line as ``python -m erfsfm``."""

from erfsfm.cli import main

if __name__ == "__main__":
    main()
