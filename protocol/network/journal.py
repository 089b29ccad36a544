"""Log lines of a process on standard error."""

import json
import sys
import time
from contextlib import suppress


class Journal:
    """Log events with run, role and key-value context on standard error: JSON lines, or plain text on a terminal."""

    def __init__(self, run: str, role: str) -> None:
        self._run, self._role = run, role

    def log(self, event: str, **keys: object) -> None:
        """Write one event."""
        if sys.stderr.isatty():
            shown = "  ".join(f"{key}={value}" for key, value in keys.items() if value != "")
            line = f"{time.strftime('%H:%M:%S')}  {self._role:<12}{event:<12}{shown}"
        else:
            entry = {"time": time.time(), "run_id": self._run, "role": self._role, "event": event, **keys}
            line = json.dumps(entry, default=str)
        with suppress(OSError):  # the disk is full: the process works without its log lines
            sys.stderr.write(line + "\n")
            sys.stderr.flush()
