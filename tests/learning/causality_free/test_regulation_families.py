"""Families: what tells queries apart, symmetries that hold, a load that is really a load."""

from dataclasses import replace

import numpy as np
import pytest

from learning.causality_free.families import (
    FAMILIES,
    context,
    free_coordinates,
    get_family,
    loaded_quadrotor,
    merging_car,
    mirrored,
)
from ocp.compiled.batch import minimised_hamiltonians, rates, state_costs
from ocp.kernels import kernels
from ocp.models import get_model
from ocp.query import Goal, Query
from ocp.regulation import regulator
from ocp.trajectory import SolveError, Status

EVERY = pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))


@EVERY
def test_starts_lie_in_the_robots_domain(family) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        query = family.sample(rng)
        for start in family.starts(query, 20, rng):
            query.check_start(start)
    assert family.starts(family.sample(rng), 0, rng).shape == (0, len(family.reach))


@EVERY
def test_queries_differ_and_can_be_regulated(family) -> None:
    rng = np.random.default_rng(1)
    queries = [family.sample(rng) for _ in range(5)]
    contexts = np.array([context(q) for q in queries])
    assert len(np.unique(contexts, axis=0)) == 5
    for query in queries:
        assert regulator(query).decay_rate > 0.1


@EVERY
def test_the_mirror_leaves_the_hamiltonian_unchanged(family) -> None:
    """So V of the mirrored state is V among mirrored obstacles: the Hamiltonian determines it."""
    rng = np.random.default_rng(2)
    query = family.sample(rng)
    signs = np.array(family.mirror)
    x = family.starts(query, 50, rng)
    p = rng.normal(size=x.shape)
    other = query.reference + signs * (x - query.reference)
    assert np.allclose(
        minimised_hamiltonians(mirrored(query, signs), other, signs * p),
        minimised_hamiltonians(query, x, p),
        rtol=1e-10, atol=1e-10,
    )  # fmt: skip


@EVERY
def test_the_goal_may_be_anywhere_along_free_coordinates(family) -> None:
    rng = np.random.default_rng(3)
    query = family.sample(rng)
    free = list(free_coordinates(query.system))
    assert free == list(query.system.position)
    x, u = family.starts(query, 20, rng), rng.normal(size=(20, query.system.m))
    moved = x.copy()
    moved[:, free] += rng.normal(size=(20, len(free)))
    assert np.array_equal(rates(query, moved, u), rates(query, x, u))


def test_a_load_moves_the_quadrotor_as_a_heavier_body_does() -> None:
    """Drake's plant, mass, inertia and thrusts times k, moves like the empty one."""
    from pydrake.multibody.tree import SpatialInertia

    from ocp.models.multibody import multibody_model
    from ocp.models.robots import robot_file

    load = 1.4
    model = multibody_model(robot_file("planar_quadrotor"))
    diagram = model.diagram()
    context_of = diagram.CreateDefaultContext()
    plant = next(s for s in diagram.GetSystems() if hasattr(s, "GetBodyByName"))
    body = plant.GetBodyByName("body")
    own = plant.GetMyMutableContextFromRoot(context_of)
    empty = body.CalcSpatialInertiaInBodyFrame(own)
    body.SetSpatialInertiaInBodyFrame(
        own,
        SpatialInertia(load * empty.get_mass(), empty.get_com(), empty.get_unit_inertia()),
    )
    rng = np.random.default_rng(4)
    query = loaded_quadrotor(load, [1.0] * 6, 0.3, np.zeros(6))
    for _ in range(5):
        x = rng.normal(size=6)
        thrust_per_load = rng.uniform(0, 5, 2)
        context_of.SetContinuousState(model.to_drake(x))
        diagram.GetInputPort("u").FixValue(context_of, load * thrust_per_load)
        told = model.from_drake(diagram.EvalTimeDerivatives(context_of).CopyToVector())
        assert np.allclose(rates(query, x, thrust_per_load), told, rtol=1e-9, atol=1e-9)


def test_a_load_weighs_thrust_as_the_loaded_quadrotor_pays_for_it() -> None:
    light = loaded_quadrotor(1.0, [1.0] * 6, 0.3, np.zeros(6))
    heavy = loaded_quadrotor(1.5, [1.0] * 6, 0.3, np.zeros(6))
    assert np.allclose(heavy.input_weights, 0.3 * 1.5**2)
    assert np.allclose(heavy.input_bounds[1] * 1.5, light.input_bounds[1])
    x = np.random.default_rng(5).normal(size=(3, 6))
    assert np.array_equal(state_costs(heavy, x), state_costs(light, x))


def test_too_heavy_a_load_cannot_hover() -> None:
    with pytest.raises(ValueError, match="holding"):
        loaded_quadrotor(2.1, [1.0] * 6, 0.3, np.zeros(6))


def test_a_car_at_rest_cannot_be_regulated_but_one_in_its_lane_can() -> None:
    from ocp.cost import RunningCost
    from ocp.query import Equilibrium

    cost = RunningCost(goal=0.0, state=tuple(map(tuple, np.eye(5).tolist())))
    with pytest.raises(ValueError, match="not stabilisable"):
        regulator(Query("car", Equilibrium((0.0,) * 5, 0.1), cost=cost))
    query = merging_car([1.0, 1.0, 0.5, 0.3, 0.3], [0.3, 0.3], [2.0, 1.5])
    assert regulator(query).decay_rate > 0.1
    assert np.abs(rates(query, query.reference, np.zeros(2))).max() < 1e-12


def test_obstacles_leave_the_goal_free_and_every_other_start_behind_one() -> None:
    family = get_family("traffic")
    rng = np.random.default_rng(6)
    for _ in range(10):
        query = family.sample(rng)
        assert 1 <= len(query.obstacles) <= 3
        assert family.why_foreign(query) is None
        bare = replace(query, obstacles=())
        rest = state_costs(query, query.reference) - state_costs(bare, query.reference)
        assert 0 < rest < 1e-6
        starts = family.starts(query, 20, rng)
        assert (query.clearance(starts) >= 0).all()
        ways = np.linspace(0.0, 1.0, 101)[:, None, None]
        straight = query.reference + ways * (starts - query.reference)
        behind = np.min(query.clearance(straight), axis=0) < 0
        assert np.mean(behind[1::2]) > 0.5


def test_one_compiled_robot_serves_all_layouts() -> None:
    family, rng = get_family("traffic"), np.random.default_rng(8)
    queries = [family.sample(rng) for _ in range(8)]
    assert len({len(q.obstacles) for q in queries}) > 1
    assert all(kernels(q) is kernels(queries[0]) for q in queries)


def test_obstacles_that_were_not_trained_on_are_refused() -> None:
    family = get_family("traffic")
    query = family.sample(np.random.default_rng(7))
    first = query.obstacles[0]
    hard = replace(first, hard=True)
    for obstacles, reason in (
        ((), "0 obstacles"),
        ((hard,), "soft circles"),
        ((replace(first, radius=1.0),), "radius"),
        ((replace(first, center=(9.0, 0.0)),), "farther"),
    ):
        assert reason in (family.why_foreign(replace(query, obstacles=obstacles)) or "")
    stronger = replace(query, cost=replace(query.cost, obstacle=4.0))
    assert "penalty" in (family.why_foreign(stronger) or "")
    assert "obstacles" in (get_family("car").why_foreign(query) or "")


def test_what_has_no_context_is_refused() -> None:
    with pytest.raises(SolveError) as refused:
        context(Query("unicycle", Goal((1.0, 1.0), 0.5)))
    assert refused.value.status is Status.NOT_APPLICABLE
    with pytest.raises(ValueError, match="known are"):
        get_family("submarine")
    assert get_model("car_in_lane").n == 5
