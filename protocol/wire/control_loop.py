"""Messages of the control loop: measurements from the plant to agents, plans from agents."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from model.arrays import Array
from model.state import INPUTS, PAYLOAD, PER_UAV
from protocol.wire import fields
from protocol.wire.fields import Agent, Count, Flag, Ids, MessageError, Shape, integer
from protocol.wire.message import Message, Route
from protocol.wire.names import AGENT, COORDINATOR, PLANT, RECORDER

PlanStatus = Literal["solved", "infeasible", "limit", "numerical"]

# States of the UAVs in `uavs`, their inputs, and these over steps.
_UavStates = Annotated[Array, Shape(lambda message: (len(message.uavs), PER_UAV))]
_Inputs = Annotated[Array, Shape(lambda message: (len(message.uavs), INPUTS))]
_Steps = Annotated[Array, Shape(lambda message: (None, INPUTS * len(message.uavs)))]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement(Message):
    """Plant to one agent: the measurements of tick k. It opens the tick for that agent."""

    kind: ClassVar[str] = "measurement"
    route: ClassVar[Route] = Route(sender=PLANT, receivers=(AGENT, RECORDER), each="agent", grows="tick")

    agent: Agent  # the agent it is for
    answered: Ids  # forwarded from the tick: agents that planned at tick k - 1
    shared: Ids  # forwarded from the tick: agents whose plans of tick k - 1 to wait for
    roster: Count  # forwarded from the tick: the version of the roster in force
    payload: Annotated[Array, Shape(lambda _: (PAYLOAD,))]  # states r0, v0, Theta0, omega0, (12,), SI
    uavs: Ids  # owned UAVs, 1-based ids, ascending
    uav_states: _UavStates  # their states e, Omega, Theta, omega, (owned, 12), SI
    inputs: _Inputs  # inputs their actuators applied until now, (owned, 4), N and N m


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan(Message):
    """Agent to plant and coordinator, if shared also to the other agents: states of its UAVs and inputs to apply.

    Its negotiation is 0 for the plan a tick ends with, otherwise how many exchanges within the tick follow.
    """

    kind: ClassVar[str] = "plan"
    route: ClassVar[Route] = Route(
        sender=AGENT,
        receivers=(AGENT, COORDINATOR, PLANT, RECORDER),
        each="agent",
        unshared_key="unshared",
        grows="tick",
        falls="negotiation",
    )

    agent: Agent  # the agent that planned
    start_tick: Count  # first sampling instant the inputs are for
    negotiation: Annotated[int, integer(0, fields.MAX_NEGOTIATION_ITERATIONS - 1)]
    shared: Flag  # whether the other agents receive it: it travels under another key if not
    uavs: Ids  # owned UAVs, 1-based ids, ascending
    uav_states: _UavStates  # their states at `tick`, (owned, 12), SI
    inputs: _Steps  # absolute inputs per step from `start_tick`, (N_p, 4 owned), N and N m
    corrections: _Steps  # corrections of these inputs to the shared control law, (N_p, 4 owned); no rows without one
    status: PlanStatus  # result of the solve; anything but "solved" means the shifted previous plan

    def _check_relations(self) -> None:
        steps = len(self.inputs)
        if not 1 <= steps <= fields.MAX_HORIZON:
            raise MessageError("out_of_range", f"inputs: expected 1 to {fields.MAX_HORIZON} steps, got {steps}")
        if len(self.corrections) not in (0, steps):
            text = f"corrections: expected none or {steps} steps, got {len(self.corrections)}"
            raise MessageError("wrong_shape", text)
