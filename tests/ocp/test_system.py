"""Laws of every registered robot."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp.models import MODELS, get_model
from ocp.models.linear import linear_system
from ocp.system import Coordinate, Input, System

EVERY = pytest.mark.parametrize("system", [get_model(name) for name in MODELS], ids=list(MODELS))


@EVERY
def test_names_and_units_are_given(system: System) -> None:
    assert system.name in MODELS
    for part in (*system.coordinates, *system.inputs):
        assert part.name
        assert part.unit
    assert len({c.name for c in system.coordinates}) == system.n


@EVERY
def test_dynamics_are_control_affine(system: System) -> None:
    """x'(a u + (1 - a) v) = a x'(u) + (1 - a) x'(v)."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = rng.uniform(system.lower, system.upper)
        u, v, a = rng.normal(size=system.m), rng.normal(size=system.m), rng.uniform(-2, 2)
        mixed = system.dynamics(x, a * u + (1 - a) * v)
        np.testing.assert_allclose(
            np.array(mixed),
            a * np.array(system.dynamics(x, u)) + (1 - a) * np.array(system.dynamics(x, v)),
            atol=1e-12,
        )


@EVERY
def test_dynamics_are_periodic_where_the_robot_says_so(system: System) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = rng.uniform(system.lower, system.upper)
        u = rng.normal(size=system.m)
        shifted = x + system.period * rng.integers(-2, 3, system.n)
        np.testing.assert_allclose(
            np.array(system.dynamics(x, u)),
            np.array(system.dynamics(shifted, u)),
            atol=1e-12,
            rtol=0,
        )
        np.testing.assert_allclose(system.wrap(shifted), system.wrap(x), atol=1e-12)


@EVERY
def test_half_turn_changes_columns_in_sign_only(system: System) -> None:
    if system.half_turn is None:
        return
    assert not system.has_drift
    matrix = ca.Function("G", [system.state], [ca.densify(system.input_matrix)])
    half = np.zeros(system.n)
    half[system.half_turn] = system.coordinates[system.half_turn].extent / 2
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = rng.uniform(system.lower, system.upper)
        G, turned = np.array(matrix(x)), np.array(matrix(x + half))
        for a, b in zip(G.T, turned.T, strict=True):
            assert np.allclose(a, b, atol=1e-12) or np.allclose(a, -b, atol=1e-12)


@EVERY
def test_equal_definitions_have_equal_fingerprints(system: System) -> None:
    again = MODELS[system.name]()
    assert again.fingerprint == system.fingerprint
    others = {get_model(name).fingerprint for name in MODELS if name != system.name}
    assert system.fingerprint not in others


def test_the_rover_is_equation_26() -> None:
    x, f = np.array([1.0, 2.0, 3.0, 4.0]), np.array([10.0, 20.0])
    expected = [3.0, 4.0, -0.5 * 1 - 1.125 * 3 + 0.25, -0.5 * 2 - 1.125 * 4 + 0.5]
    np.testing.assert_allclose(
        np.array(get_model("rover").dynamics(x, f)).ravel(), expected, rtol=1e-15
    )


@given(st.lists(st.floats(-50, 50), min_size=3, max_size=3))
def test_difference_is_the_short_way_round(shift: list[float]) -> None:
    system = get_model("unicycle")
    gap = system.difference(np.add([1.0, 2.0, 3.0], shift), [1.0, 2.0, 3.0])
    assert abs(gap[2]) <= np.pi + 1e-9
    assert np.cos(gap[2]) == pytest.approx(np.cos(shift[2]), abs=1e-9)
    np.testing.assert_allclose(gap[:2], shift[:2], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"drift": ca.SX.zeros(2, 1)}, "drift has shape"),
        ({"input_matrix": ca.SX.zeros(1, 2)}, "input_matrix has shape"),
        ({"position": (3,)}, "position indices"),
        ({"half_turn": 0}, "half_turn coordinate must be periodic"),
    ],
)
def test_a_wrong_definition_is_refused(change: dict, message: str) -> None:
    x = ca.SX.sym("x", 1)
    good = {
        "name": "point",
        "coordinates": (Coordinate("x", "m", -1, 1),),
        "inputs": (Input("u", "m/s"),),
        "state": x,
        "drift": ca.SX.zeros(1, 1),
        "input_matrix": ca.SX.ones(1, 1),
        "position": (0,),
    }
    System(**good)
    with pytest.raises(ValueError, match=message):
        System(**(good | change))


def test_wrong_matrices_are_refused() -> None:
    coordinates, inputs = (Coordinate("x", "m", -1, 1),), (Input("u", "m/s"),)
    for A, B, message in (
        (np.eye(2), [[1.0]], "A must be 1 x 1"),
        ([[np.nan]], [[1.0]], "must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            linear_system("point", A, B, coordinates, inputs, (0,))


def test_an_unknown_robot_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="'hovercraft' is not registered; known are unicycle"):
        get_model("hovercraft")
