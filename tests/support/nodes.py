"""Nodes behind the checks that depend on their run and their present tick, as in their processes."""

from collections.abc import Sequence
from typing import Any

from transport.agent import node as agent_node
from transport.coordinator import node as coordinator_node
from transport.flight.roles import plant_run, team_view
from transport.plant import node as plant_node
from transport.protocol.admission.acceptance_and_refusals import Rejections
from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Event, Message


class _Checked:
    """A node that counts the messages its gate would refuse for their content or moment."""

    def __init__(self, setup: Setup, *args: Any, **options: Any) -> None:
        self.rejected, self.shape = Rejections(), setup.rules.shape
        super().__init__(*args, **options)

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Handle an event, unless it is a message that is refused."""
        node: Any = super()
        if isinstance(event, Message):
            try:
                check_plausible(event, self.shape)
                node.check_moment(event)
            except MessageError as error:
                self.rejected.add(event.sender, error)
                return ()
        answers: Sequence[Message] = node.receive(event, now_ns)
        return answers


class AgentNode(_Checked, agent_node.AgentNode):
    """Agent behind the checks."""

    def __init__(self, setup: Setup, *args: Any, **options: Any) -> None:
        super().__init__(setup, setup.run, *args, **options)


class PlantNode(_Checked, plant_node.PlantNode):
    """Plant behind the checks."""

    def __init__(self, setup: Setup, *args: Any, **options: Any) -> None:
        super().__init__(setup, plant_run(setup), *args, **options)


class CoordinatorNode(_Checked, coordinator_node.CoordinatorNode):
    """Coordinator behind the checks."""

    def __init__(self, setup: Setup, **options: Any) -> None:
        super().__init__(setup, setup.rules, team_view(setup), **options)


def refused(node: Any) -> list[tuple[str, str, int]]:
    """Return the rejections of such a node as sender, reason and count."""
    return [(entry.sender, entry.reason, entry.count) for entry in node.rejected]
