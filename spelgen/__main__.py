"""`python -m spelgen` is the command `spelgen`."""

from spelgen.cli.main import main

if __name__ == "__main__":
    main()
