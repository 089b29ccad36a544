"""Physical parameters: what is refused and how, what is kept, and the paper's Table I."""

import re
from dataclasses import replace

import numpy as np
import pytest

from transport.model.arrays import ArrayLike, ShapeError
from transport.model.physics.parameters import (
    Payload,
    System,
    Uav,
    payload_half_size,
    resting_height,
    table_1,
)

NAN, INF = float("nan"), float("inf")

# (value, what the text must say after the field's name), for every inertia.
BAD_INERTIA: list[tuple[ArrayLike, str]] = [
    ([1.0, 1.0], "expected shape (3), got (2)"),
    (np.eye(2), "expected shape (3, 3), got (2, 2)"),
    (np.ones((2, 3, 3)), "expected shape (3, 3), got (2, 3, 3)"),
    ([NAN, 1.0, 1.0], "expected finite numbers, got nan"),
    (np.diag([1.0, INF, 1.0]), "expected finite numbers, got inf"),
    (
        [[1.0, 0.1, 0.0], [0.2, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "expected a symmetric matrix, got [[1.0, 0.1, 0.0], [0.2",
    ),
    ([1.0, 1.0, -0.5], "expected positive principal moments, got [-0.5, 1.0, 1.0] kg m^2"),
    ([1.0, 1.0, 0.0], "expected positive principal moments, got [0.0, 1.0, 1.0] kg m^2"),
    ([[1.0, 1e-6, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "expected a symmetric matrix, got "),
    ([1.0, 1.0, 2.0 + 1e-6], "no body has principal moments [1.0, 1.0, 2.000001] kg m^2"),
    # Positive entries, but a determinant below zero: the principal moments decide, not the
    # diagonal.
    ([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "expected positive principal moments"),
    (
        [1.0, 1.0, 2.1],
        "no body has principal moments [1.0, 1.0, 2.1] kg m^2: the largest exceeds the sum",
    ),
]


def uav(
    mass: float = 1.5,
    inertia: ArrayLike = (0.03, 0.03, 0.05),
    rho: ArrayLike = (0.2, 0.1, -0.1),
    rod: float = 3.0,
) -> Uav:
    """A UAV that is fine but for what the test changes."""
    return Uav(mass=mass, inertia=inertia, rho=rho, rod_length=rod)


@pytest.mark.parametrize(("value", "text"), BAD_INERTIA)
def test_impossible_inertias_are_refused(value: ArrayLike, text: str) -> None:
    """J_0 and J_i must be symmetric, positive and obey the triangle inequality.

    The text says which failed.
    """
    with pytest.raises(ValueError, match=re.escape(f"payload inertia: {text}")):
        Payload(mass=1.0, inertia=value)
    with pytest.raises(ValueError, match=re.escape(f"UAV inertia: {text}")):
        uav(inertia=value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([0.1, 0.2], "expected shape (3), got (2)"),
        (0.1, "expected shape (3), got ()"),
        ([0.1, NAN, 0.2], "expected finite numbers, got nan"),
        ([0.1, -INF, 0.2], "expected finite numbers, got -inf"),
        ([[0.1], [0.2, 0.3]], "expected an array of numbers, got [[0.1], [0.2, 0.3]]"),
        ("corner", "expected an array of numbers, got 'corner'"),
    ],
)
def test_attachment_points_must_be_vectors(value: ArrayLike, text: str) -> None:
    """rho_i is three finite numbers; anything else is refused by name."""
    with pytest.raises(ShapeError, match=re.escape(f"rho: {text}")):
        uav(rho=value)


def test_table_1_has_the_papers_values() -> None:
    """Paper, Table I: masses, inertias, attachment points in the order UAV1..UAV4, rod lengths."""
    system = table_1()
    assert system.payload.mass == 3.0
    assert np.array_equal(system.payload.inertia, 0.556 * np.eye(3))
    assert [own.mass for own in system.uavs] == [1.5] * 4
    assert all(np.array_equal(own.inertia, np.diag([0.029, 0.029, 0.055])) for own in system.uavs)
    assert [own.rho.tolist() for own in system.uavs] == [
        [0.25, 0.25, -0.125],
        [0.25, -0.25, -0.125],
        [-0.25, -0.25, -0.125],
        [-0.25, 0.25, -0.125],
    ]
    assert [own.rod_length for own in system.uavs] == [3.2] * 4
    assert (system.N, system.n, system.m, system.p, system.total_mass) == (4, 60, 16, 25, 9.0)
    assert system.gravity == 9.81
    heavier = (*system.uavs[:3], replace(system.uavs[3], mass=2.0))
    assert replace(system, uavs=heavier).total_mass == 9.5


@pytest.mark.parametrize("is_asked", [False, True])
@pytest.mark.parametrize(
    ("payload", "across", "along"), [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, 0.2)]
)
def test_equations_have_drag_if_one_body_has_it(
    payload: float, across: float, along: float, *, is_asked: bool
) -> None:
    """Or if it is asked for, to be estimated: then the parameters end with the drag of all bodies."""
    bodies = table_1()
    uavs = (*bodies.uavs[:3], replace(bodies.uavs[3], drag=np.array([across, along])))
    system = System(payload=replace(bodies.payload, drag=payload), uavs=uavs, has_drag=is_asked)
    has_drag = is_asked or payload + across + along > 0.0
    assert system.has_drag is has_drag
    assert system.kind.drag is has_drag
    end = [payload, *[0.0, 0.0] * 3, across, along]
    assert len(system.vector()) == 8 + 11 * 4 + len(end) * has_drag
    assert not has_drag or system.vector()[-9:].tolist() == end


def test_a_flat_body_is_one() -> None:
    """Its largest principal moment is the sum of the others: exactly, and up to rounding."""
    for largest in (2.0, 2.0 * (1.0 + 1e-15)):
        assert Payload(mass=1.0, inertia=[1.0, 1.0, largest]).inertia[2, 2] == largest


def test_the_box_of_a_payload_by_hand() -> None:
    """It reaches the attachment points, about the point taken for the centre of mass, and has a least height."""
    bodies = table_1()
    flat = [replace(one, rho=np.array([*one.rho[:2], 0.0])) for one in bodies.uavs]
    payload = replace(bodies.payload, centre=np.array([0.1, 0.0, 0.01]))
    system = replace(bodies, payload=payload, uavs=tuple(flat))
    assert payload_half_size(bodies).tolist() == [0.25, 0.25, 0.125]
    assert payload_half_size(system) == pytest.approx([0.35, 0.25, 0.05])
    assert resting_height(bodies, -2.0) == -2.125
