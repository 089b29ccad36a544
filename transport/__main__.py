"""The command `transport`, also as `python -m transport`."""

import os
import signal
import sys

from protocol.network.parent import ending_signals, wake_with_its_end
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.cli.standard_streams import standard_streams
from transport.flight.fork_server import fork_server
from transport.flight.signals import raise_interrupts


def main() -> None:
    """Run the command; SIGTERM and SIGHUP end it like Ctrl-C, from the first import to the end."""
    if sys.getfilesystemencoding() != "utf-8" and os.environ.get("PYTHONUTF8") != "1":
        # Paths are UTF-8 for Zenoh and in TOML, whatever the locale.
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "PYTHONUTF8": "1"})  # noqa: S606
    try:
        wake_with_its_end()
        raise_interrupts()  # before the imports: they take a while
        if sys.argv[1:2] == ["run"] and not {"-h", "--help"} & set(sys.argv):
            fork_server()  # imports for the processes of the run while this process imports for itself
        with standard_streams():
            from transport.cli.main import app

            app(prog_name="transport")
    except KeyboardInterrupt:  # during the imports
        sys.exit(EXIT_INTERRUPTED)
    finally:
        # CPython remembers an interrupt during `exec` of a text, as in the definition of a dataclass, and would end by
        # SIGINT whatever the exit code; the next `exec` forgets it.
        exec("")  # noqa: S102  # nothing is executed
        # The exit code is decided. The interpreter restores the default handlers when it shuts down; a signal during
        # that would still kill the process.
        for number in ending_signals():
            signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    main()
