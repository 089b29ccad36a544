"""Signs of life: what is stopped, what is idle, what works, and what has ended although its tracer keeps it."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from tests.support.commands import wait_for
from tests.support.trace_stop import trace_stopped
from transport.flight import vitals as module
from transport.flight.fork_server import Forked
from transport.flight.vitals import Pulse, Vitals, children_of, has_died, kill_leftovers, vitals

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/proc is that of Linux")

SLEEPS = "import time; print(flush=True); time.sleep(600)"
WORKS = "print(flush=True)\nwhile True: pass"


@pytest.fixture
def start() -> Iterator[Callable[[str], int]]:
    """Return a function that starts a program and returns its process id once it runs."""
    started: list[subprocess.Popen[bytes]] = []

    def begin(program: str) -> int:
        process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline()
        return process.pid

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def looked(pulse: Pulse, is_enough: Callable[[Pulse], bool]) -> bool:
    """Look at a process until something is true; return whether it came true."""

    def look() -> bool:
        pulse.look()
        return is_enough(pulse)

    return wait_for(look)


def test_a_process_that_sleeps_is_idle(start: Callable[[str], int]) -> None:
    """It could have run, is not stopped, and is described as asleep."""
    pulse = Pulse(start(SLEEPS))
    assert looked(pulse, lambda p: p.idle_s > 0.3)
    assert pulse.stopped_s == 0.0
    assert pulse.given_s >= pulse.idle_s
    assert pulse.description == "asleep"


def test_a_process_that_works_is_not_idle(start: Callable[[str], int]) -> None:
    """Its processor time grows; it is neither idle nor stopped."""
    pulse = Pulse(start(WORKS))
    assert looked(pulse, lambda p: p.ran_s > 0.2)
    assert (pulse.idle_s, pulse.stopped_s) == (0.0, 0.0)


@pytest.mark.parametrize("program", [SLEEPS, WORKS])
def test_a_stopped_process(program: str, start: Callable[[str], int]) -> None:
    """SIGSTOP is seen and named; after SIGCONT the time begins anew."""
    pid = start(program)
    os.kill(pid, signal.SIGSTOP)
    pulse = Pulse(pid)
    assert looked(pulse, lambda p: p.stopped_s > 0.2)
    assert pulse.description == "stopped by a signal"
    os.kill(pid, signal.SIGCONT)
    assert looked(pulse, lambda p: p.stopped_s == 0.0)


@pytest.mark.parametrize("first_thread", [False, True])
def test_a_trace_stop(first_thread: bool, start: Callable[[str], int]) -> None:
    """A process under a tracer is stopped, and goes on when the tracer leaves."""
    pid = start(WORKS)
    pulse = Pulse(pid)
    with trace_stopped(pid, first_thread=first_thread):
        assert looked(pulse, lambda p: p.stopped_s > 0.2)
        assert pulse.description == "stopped by a tracer"
    assert looked(pulse, lambda p: p.stopped_s == 0.0)


def test_time_without_looks_and_without_a_processor_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stopped observer has seen nothing; a process that waits for a processor is not idle and was given no time."""
    seen = [Vitals("S", 1.0, 0.0), Vitals("S", 1.0, 0.0), Vitals("R", 1.0, 0.4), Vitals("S", 1.0, 0.4), None]
    times = iter([0.0, 30.0, 30.5, 30.75, 31.0])
    monkeypatch.setattr(module, "vitals", lambda _: seen.pop(0))
    monkeypatch.setattr(time, "monotonic", lambda: next(times))
    pulse = Pulse(1)
    pulse.look()  # after 30 s
    assert (pulse.idle_s, pulse.given_s) == (1.0, 1.0)
    pulse.look()  # 0.4 of 0.5 s in the queue of the processor
    assert pulse.idle_s == 0.0
    assert pulse.given_s == pytest.approx(1.1)
    pulse.look()
    assert pulse.idle_s == 0.25
    pulse.look()  # the process has ended
    assert pulse.given_s == pytest.approx(1.6)


def test_a_killed_process_that_its_tracer_keeps() -> None:
    """It has died although its parent cannot reap it; waiting for it ends in time."""
    pid = os.posix_spawn(sys.executable, [sys.executable, "-c", SLEEPS], {})
    reads, writes = os.pipe()
    os.close(reads)
    child = Forked(pid, os.fdopen(writes, "wb"))
    try:
        with trace_stopped(pid):
            child.terminate()
            assert not has_died(pid)
            child.kill()
            assert wait_for(lambda: has_died(pid))
            with pytest.raises(subprocess.TimeoutExpired):
                child.wait(0.2)
        assert child.wait() == -signal.SIGKILL
        assert has_died(pid)
    finally:
        child.kill()
        child.stdin.close()


def test_children_are_those_of_all_threads(start: Callable[[str], int]) -> None:
    """A child started by another thread counts; a process that is gone has none."""
    started: list[int] = []
    thread = threading.Thread(target=lambda: started.append(start(SLEEPS)))
    thread.start()
    thread.join()
    assert started[0] in children_of(os.getpid())
    assert children_of(started[0]) == []
    os.kill(started[0], signal.SIGKILL)
    os.waitpid(started[0], 0)
    assert children_of(started[0]) == []


def test_leftovers_are_found_by_their_title(start: Callable[[str], int]) -> None:
    """Only children with one of the titles are killed."""
    pids = [start(SLEEPS), start(WORKS)]
    title = f"{sys.executable} -c {SLEEPS}"
    assert not kill_leftovers(os.getpid(), frozenset({title}), frozenset(pids))
    assert kill_leftovers(os.getpid(), frozenset({title}), frozenset())
    assert wait_for(lambda: has_died(pids[0]))
    assert not has_died(pids[1])
    assert not kill_leftovers(os.getpid(), frozenset({title}), frozenset())


def test_a_process_that_is_gone() -> None:
    """Nothing is known of it; a look at it raises nothing."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    assert vitals(gone.pid) is None
    assert has_died(gone.pid)
    with suppress(ProcessLookupError):
        Pulse(gone.pid).look()
