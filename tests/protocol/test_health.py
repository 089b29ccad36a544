"""Memory that a process returns to its host."""

import platform
import subprocess
import sys

import pytest

# Fragments memory, and prints by how many bytes the process shrinks when it returns what is free.
FREE_BETWEEN = """
from pathlib import Path
from protocol.network.health import give_back_memory

def own_bytes():
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon:"))

blocks, between = [], []
for _ in range(400):
    blocks.append(bytes([1]) * 100_000)
    between.append(bytes([1]) * 1000)
del blocks
before = own_bytes()
give_back_memory()
print(before - own_bytes())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc returns memory on request")
def test_memory_is_returned() -> None:
    """Memory kept by the allocator is returned to the system, most of 40 MB here."""
    found = subprocess.run([sys.executable, "-c", FREE_BETWEEN], capture_output=True, text=True, check=True, timeout=60)
    assert int(found.stdout) > 30e6
