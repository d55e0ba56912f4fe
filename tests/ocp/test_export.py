"""Policies as C99: what a C compiler makes of them is the policy that Python runs."""

from pathlib import Path

import numpy as np
import pytest
from c_compiler import compiled_policy, needs_compiler
from numpy.testing import assert_allclose
from references import ALL_QUERIES, typical_query

from ocp.eikonal import solve_eikonal
from ocp.export import export_c
from ocp.grid import Grid
from ocp.obstacle import Obstacle
from ocp.query import Query
from ocp.query_family import PAPER_FAMILY, paper_query
from ocp.regulation import RegulatorValue, regulator
from ocp.riccati import LinearQuadratic, QuadraticValue, algebraic_riccati
from ocp.value import greedy

COUNT = 1_000
PENDULUM = Query.load(Path(__file__).parents[2] / "sims/queries/pendulum.toml")


@needs_compiler
def test_a_linear_regulator(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    problem = LinearQuadratic(
        rng.normal(size=(6, 6)), rng.normal(size=(6, 2)), np.eye(6), np.eye(2), rng.normal(size=6)
    )
    solution = algebraic_riccati(problem)
    states = rng.normal(0.0, 3.0, (COUNT, 6))
    found = compiled_policy(export_c(solution, tmp_path))(states)
    expected = solution.input(states)
    assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


@needs_compiler
def test_a_regulator_of_a_query_turns_the_short_way_round_and_keeps_to_its_bounds(tmp_path) -> None:
    policy = greedy(PENDULUM, RegulatorValue(PENDULUM))
    states = np.random.default_rng(1).uniform(-10.0, 10.0, (COUNT, 2))
    found, expected = compiled_policy(export_c(policy, tmp_path))(states), policy(states)
    assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    _, upper = PENDULUM.input_bounds
    assert (np.abs(expected) == upper).any()  # so that bounds are seen to hold
    assert (np.abs(expected) < upper).any()


@needs_compiler
@pytest.mark.parametrize("model", sorted({name for name, _ in ALL_QUERIES}))
def test_a_quadratic_value_s_policy_for_every_robot(model: str, tmp_path: Path) -> None:
    query, rng = typical_query(model, bounded=True), np.random.default_rng(2)
    n = query.system.n
    root = rng.normal(size=(n, n))
    policy = greedy(query, QuadraticValue(root @ root.T, query.reference))
    states = rng.uniform(0.7 * query.system.lower, 0.7 * query.system.upper, (COUNT, n))
    found, expected = compiled_policy(export_c(policy, tmp_path))(states), policy(states)
    assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@needs_compiler
@pytest.mark.parametrize("hard", [False, True])
def test_the_lookahead_on_a_grid(hard: bool, tmp_path: Path) -> None:
    if hard:
        query = Query(
            "unicycle", paper_query((4.0, 4.0)).goal, (Obstacle.circle((0, 0), 1.0, hard=True),)
        )
    else:
        query = PAPER_FAMILY.sample(np.random.default_rng(3))
    policy = solve_eikonal(query, Grid.for_query(query, 4_000)).policy()
    states = np.random.default_rng(4).uniform(-5.0, 5.0, (COUNT, 3))
    found, expected = compiled_policy(export_c(policy, tmp_path, "grid"))(states), policy(states)
    assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_what_is_written(tmp_path: Path) -> None:
    exported = export_c(regulator(PENDULUM), tmp_path / "made", "swing")
    assert (exported.states, exported.inputs) == (2, 1)
    header, source = exported.header.read_text(), exported.source.read_text()
    assert "#define SWING_STATES 2" in header
    assert "void swing_input(const double *state, double *input);" in header
    includes = {line for line in source.splitlines() if line.startswith("#include")}
    system = {"<math.h>", "<stdint.h>", "<stdlib.h>"}
    assert includes == {'#include "swing.h"'} | {f"#include {name}" for name in system}
    for word in ("malloc", "free(", "printf"):
        assert word not in source


@pytest.mark.parametrize("name", ["", "two words", "1st", "größe"])
def test_a_name_that_c_does_not_know_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="name: must be a C identifier"):
        export_c(regulator(PENDULUM), tmp_path, name)


def test_a_policy_that_is_not_made_of_kernels_is_refused(tmp_path: Path) -> None:
    query = paper_query((4.0, 4.0))
    policy = greedy(query, QuadraticValue(np.eye(3), np.zeros(3)))  # scaled in Python
    with pytest.raises(ValueError, match="GreedyPolicy is not made of kernels"):
        export_c(policy, tmp_path)
    assert not list(tmp_path.iterdir())
