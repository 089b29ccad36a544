"""`python -m transport` is the command `transport`."""

import signal
import sys

from protocol.parent import wake_with_its_end

try:
    wake_with_its_end()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a signal while this imports is one already
    from transport.main import main

    main()
except KeyboardInterrupt:  # before the command could do anything about it
    sys.exit(130)
