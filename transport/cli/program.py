"""The command `transport`, also as `python -m transport`: what a signal does to it from its first import to its end."""

import signal
import sys

from protocol.network.parent import wake_with_its_end

_EXIT_INTERRUPTED = 130


def main() -> None:
    """Entry point. Whoever ends a command by SIGTERM gets what Ctrl-C gives: nothing is left half done."""
    try:
        wake_with_its_end()
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a signal while this imports is one already
        from transport.cli.main import app

        app(prog_name="transport")
    except KeyboardInterrupt:  # before the command could do anything about it
        sys.exit(_EXIT_INTERRUPTED)
    finally:
        # Its exit code is decided. Python gives signals back their default while it takes itself apart, which takes a
        # while: one that comes then would still kill it.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
