"""Constraints of a program: one file each, the same rows about any trajectory.

The order of this list is that of the rows and slacks of all programs. A new constraint has a file
here, an entry in `constraints_of` and its section in `transport.mpc.settings_period_horizon_weights`.
"""

from transport.mpc.program.constraints.block import Constraint
from transport.mpc.program.constraints.input_limits import Rates
from transport.mpc.program.constraints.rod_tension import Tension
from transport.mpc.program.constraints.separation import Separation
from transport.mpc.program.constraints.tilt import Tilt
from transport.mpc.program.constraints.user_constraints import OwnInputs, OwnStates
from transport.mpc.program.decision import Decision


def constraints_of(decision: Decision) -> list[Constraint]:
    """Return the constraints that the settings of a controller name, and the rates."""
    settings = decision.settings
    constraints: list[Constraint] = [Rates(decision)]
    if settings.separation is not None:
        constraints.append(Separation(decision, settings.separation))
    if settings.tilt is not None:
        constraints.append(Tilt(decision, settings.tilt))
    if settings.constraint:
        constraints.append(OwnStates(decision))
        constraints.append(OwnInputs(decision))
    if settings.tension is not None:
        constraints.append(Tension(decision, settings.tension))
    return constraints
