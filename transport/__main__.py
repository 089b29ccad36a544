"""`python -m transport` is the command `transport`."""

import sys

try:
    from transport.main import main

    main()
except KeyboardInterrupt:  # before the command could do anything about it
    sys.exit(130)
