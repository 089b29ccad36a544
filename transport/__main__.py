"""The command `transport`, also as `python -m transport`."""

from transport.cli.program import main

if __name__ == "__main__":
    main()
