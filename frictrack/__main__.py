"""`python -m frictrack` is the command line."""

from frictrack.cli import main

if __name__ == "__main__":
    main()
