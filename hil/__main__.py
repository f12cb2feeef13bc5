"""Make `python -m hil` run the `hil` command."""

from hil.cli.app import main

if __name__ == "__main__":
    main()
