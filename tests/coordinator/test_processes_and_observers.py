"""Processes that tick 0 waits for, and observers that come and go."""

from transport.coordinator.processes_and_observers import Processes
from transport.protocol.wire.names import PLANT

AGENTS = ("agent1", "agent2")
RECORDER = "recorder"


def test_tick_0_waits_for_all() -> None:
    """Plant, agents, vehicles and observers, in any order; the last one says so."""
    processes = Processes(AGENTS, ("vehicle1",), (RECORDER,), has_plant=True)
    early = (RECORDER, "vehicle1", *AGENTS)
    assert not any(processes.join(name) for name in early)
    assert processes.join(PLANT)


def test_without_a_plant_nothing_waits_for_it() -> None:
    """It may be heard all the same, as a process that takes part."""
    processes = Processes(("agent1",), ("vehicle1",), (), has_plant=False)
    assert processes.is_expected(PLANT)
    assert not processes.join("vehicle1")
    assert processes.join("agent1")


def test_an_observer_departs_and_comes_back() -> None:
    """Only observers do; a second recorder is no process of the run."""
    processes = Processes(AGENTS, (), (RECORDER,), has_plant=True)
    assert not processes.is_expected("viewer")
    processes.depart("agent1")
    assert not processes.is_departed("agent1")
    processes.depart(RECORDER)
    assert processes.observers == set()
    assert processes.is_departed(RECORDER)
    processes.come_back(RECORDER)
    assert processes.observers == {RECORDER}
    assert not processes.is_departed(RECORDER)
