"""`python -m transport` is the command `transport`."""

from transport.main import main

main()
