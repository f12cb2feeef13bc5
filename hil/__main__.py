"""Run the `hil` command as `python -m hil`."""

from hil.cli.app import main

if __name__ == "__main__":
    main()
