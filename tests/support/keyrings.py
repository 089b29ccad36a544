"""Certificates for the tests, signed by independent authorities."""

import atexit
import shutil
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp

from transport.deploy.certificates import LOOPBACK, OTHERS, make_certificates

NAMES = ("coordinator", "plant", "agent1", "agent2", "agent3", "agent4", *OTHERS)


@lru_cache
def keyring(authority: str) -> Path:
    """Return a folder of certificates for all names, signed by the authority of that name, which tests share."""
    folder = Path(mkdtemp(prefix=f"keys-{authority}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    make_certificates(folder, dict.fromkeys(NAMES, LOOPBACK), days=1)
    return folder
