"""`python -m mabl` is `mabl`."""

from mabl.cli import main

if __name__ == "__main__":
    main()
