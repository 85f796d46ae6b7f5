"""Run the command line by `python -m frictrack`."""

from frictrack.cli import main

if __name__ == "__main__":
    main()
