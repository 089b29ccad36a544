"""Real-time priority of an observer, in a process of its own."""

import subprocess
import sys

import pytest

PROGRAM = """
import os, sys, threading
from transport.flight.observer_priority import below_the_team

try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
except (AttributeError, PermissionError):
    sys.exit("not permitted")
end = threading.Event()
threading.Thread(target=end.wait).start()

def priorities():
    tasks = os.listdir("/proc/self/task")
    return sorted({os.sched_getparam(int(task)).sched_priority for task in tasks})

with below_the_team():
    print(priorities())
    with below_the_team():
        print(priorities())
print(priorities())
os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
with below_the_team():
    print(os.sched_getscheduler(0) == os.SCHED_OTHER)
end.set()
"""


def test_all_threads_of_an_observer_are_one_priority_below_the_team() -> None:
    """Within the block, not below the least priority, and not in another scheduling class."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False
    )
    if done.stderr.strip() == "not permitted":
        pytest.skip("needs the right to set a real-time priority")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n") == ["[1]", "[1]", "[2]", "True", ""]
