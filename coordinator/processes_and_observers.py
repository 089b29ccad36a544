"""The processes of a run beside its roster: those that tick 0 waits for, the vehicles, and the observers."""

from collections.abc import Collection

from transport.protocol.wire.names import PLANT


class Processes:
    """Processes of a run by name; which agents take part in its ticks is on the roster alone.

    Tick 0 waits for the plant, all agents, all vehicles and all observers. An observer, such as "recorder", may
    depart and come back; the run does not depend on it.

    Attributes:
        vehicles: Names of the vehicles.
        observers: Observers that have not departed.
    """

    def __init__(
        self,
        agents: Collection[str],
        vehicles: Collection[str],
        observers: Collection[str],
        *,
        has_plant: bool,
    ) -> None:
        self.vehicles = frozenset(vehicles)
        self.observers = set(observers)
        self._departed: set[str] = set()  # observers
        plant = {PLANT} if has_plant else set()
        self._awaited = {*plant, *agents, *vehicles, *observers}
        self._taking_part = frozenset({PLANT, *agents, *vehicles})

    def is_expected(self, name: str) -> bool:
        """Return whether a process takes part, or is an observer that tick 0 still waits for."""
        return name in self._taking_part or name in self._awaited

    def join(self, name: str) -> bool:
        """Note that a process is ready before tick 0; return whether that waits for no other one."""
        self._awaited.discard(name)
        return not self._awaited

    def depart(self, name: str) -> None:
        """Note that a process is gone, if it is an observer."""
        if name in self.observers:
            self.observers.remove(name)
            self._departed.add(name)

    def is_departed(self, name: str) -> bool:
        """Return whether a process is an observer that has departed."""
        return name in self._departed

    def come_back(self, name: str) -> None:
        """Note that an observer that had departed is here again."""
        self._departed.remove(name)
        self.observers.add(name)
