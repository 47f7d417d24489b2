"""`python -m sympflow`: the command line."""

from sympflow.cli import main

if __name__ == "__main__":
    main()
