"""Nonsense in, clear words out: a ValueError that names the field, or a status; never a crash."""

import copy
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ocp.eikonal import solve_eikonal
from ocp.grid import Grid, GridValue
from ocp.query import Query
from ocp.query_family import paper_query
from ocp.query_file import query_from_dict, query_to_dict, read_toml
from ocp.trajectory import SolveError
from sims.closed_loop import LoopSettings, rollouts
from sims.disturbance import Disturbance

GOOD: dict[str, Any] = query_to_dict(paper_query((1.0, 4.0)))
GOOD["cost"] = {"goal": 1.0, "input": [1.0, 1.0]}
GOOD["input"] = {"lower": [-1.0, -1.0], "upper": [1.0, 1.0]}
GOOD["robot"] = {"radius": 0.1}

NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(-(10**30), 10**30),
    st.sampled_from([0, -1, 1e-300, 1e300, 0.5, True]),
)
NONSENSE = st.recursive(
    st.one_of(st.none(), NUMBERS, st.text(max_size=8), st.booleans()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)
MANY = settings(max_examples=300, suppress_health_check=[*HealthCheck])  # pyright: ignore[reportArgumentType]


def places(table: Any, path: tuple = ()) -> list[tuple]:
    """The path of every value in nested tables and lists."""
    found = [path] if path else []
    items = table.items() if isinstance(table, dict) else enumerate(table)
    for key, value in items:
        if isinstance(value, dict | list):
            found += places(value, (*path, key))
        else:
            found.append((*path, key))
    return found


def with_value(table: dict[str, Any], path: tuple, value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(table)
    inner: Any = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return changed


def assert_said(error: Exception) -> None:
    """A refusal that says something."""
    assert str(error)


# Query files


@MANY
@given(place=st.sampled_from(places(GOOD)), value=NONSENSE)
def test_any_value_anywhere_in_a_query_file(place: tuple, value: Any) -> None:
    """Taken, and then it is a query that can be written and read again; or refused in words."""
    try:
        query = query_from_dict(with_value(GOOD, place, value))
    except ValueError as error:
        assert_said(error)
        return
    assert query_from_dict(query_to_dict(query)) == query


@MANY
@given(table=st.dictionaries(st.sampled_from([*GOOD, "goals", ""]), NONSENSE, max_size=5))
def test_any_tables_at_all(table: dict[str, Any]) -> None:
    try:
        query_from_dict(table)
    except ValueError as error:
        assert_said(error)


@MANY
@given(content=st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)))
def test_any_bytes_as_a_file(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "query.toml"
    path.write_bytes(content)
    try:
        Query.load(path)
    except ValueError as error:
        assert_said(error)


def test_deep_nesting_is_refused(tmp_path) -> None:
    path = tmp_path / "deep.toml"
    path.write_text("goal = " + "[" * 100_000 + "]" * 100_000)
    with pytest.raises(ValueError, match="TOML"):
        read_toml(path)


def test_dangerous_model_names_are_only_names() -> None:
    for name in ("../../etc/passwd", "/etc/passwd", "os.system", "unicycle\0", "", "x" * 10_000):
        with pytest.raises(ValueError, match="model"):
            query_from_dict({**GOOD, "model": name})


# System files


@MANY
@given(data=st.data())
def test_any_value_anywhere_in_a_system_file(data: st.DataObject, tmp_path_factory) -> None:
    import tomli_w

    from sims.regulation.system_file import SystemFile

    good = {
        "A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "M": [[1.0, 0.0], [0.0, 1.0]],
        "R": [[1.0]], "terminal": [[1.0, 0.0], [0.0, 1.0]], "horizon": 2.0, "start": [1.0, 0.0],
        "noise": 0.0, "probing": 1.0,
    }  # fmt: skip
    value = data.draw(NONSENSE.filter(_writable))
    changed = with_value(good, data.draw(st.sampled_from(places(good))), value)
    path = tmp_path_factory.mktemp("fuzz") / "system.toml"
    path.write_text(tomli_w.dumps(changed), encoding="utf-8")
    try:
        SystemFile.load(path)
    except ValueError as error:
        assert_said(error)


def _writable(value: Any) -> bool:
    """Whether TOML can hold it."""
    if isinstance(value, dict):
        return all(map(_writable, value.values()))
    if isinstance(value, list):
        return all(map(_writable, value))
    if isinstance(value, str):
        return not any(0xD800 <= ord(c) < 0xE000 for c in value)
    return value is not None and not (isinstance(value, int) and abs(value) >= 2**63)


# Arrays


SOLUTION = solve_eikonal(paper_query((4.0, 4.0)), nodes=1500)
ARRAYS = st.one_of(
    st.lists(NUMBERS, max_size=5),
    st.lists(st.lists(NUMBERS, min_size=2, max_size=4), max_size=4),
    st.sampled_from([None, "x", {}, [[]], np.zeros((0, 3)), np.zeros((2, 0)), np.array(1.0)]),
)


@MANY
@given(states=ARRAYS)
def test_any_array_as_states(states: Any) -> None:
    """Values are finite or infinite, never NaN; inputs finite; or the array is refused."""
    for ask in (SOLUTION.value.value, SOLUTION.value.gradient, SOLUTION.policy()):
        try:
            answer = np.asarray(ask(states))
        except (ValueError, TypeError, OverflowError) as error:
            assert_said(error)
        else:
            assert not np.isnan(answer).any()


@MANY
@given(start=ARRAYS)
def test_any_array_as_a_start(start: Any) -> None:
    query = SOLUTION.query
    try:
        state = query.check_start(start)
    except (ValueError, TypeError, OverflowError) as error:
        assert_said(error)
        return
    assert state.shape == (3,)
    assert np.isfinite(state).all()
    (loop,) = rollouts(SOLUTION.policy(), [state], LoopSettings(time_limit=1.0))
    assert loop.cost is None or math.isfinite(loop.cost)


@MANY
@given(
    lower=st.lists(NUMBERS, max_size=4), upper=st.lists(NUMBERS, max_size=4),
    shape=st.lists(st.integers(-5, 30), max_size=4), value=NUMBERS,
)  # fmt: skip
def test_any_numbers_as_a_grid(lower: list, upper: list, shape: list, value: Any) -> None:
    try:
        grid = Grid(tuple(lower), tuple(upper), tuple(shape), (False,) * len(shape))
        GridValue(grid, np.full(grid.shape, float(value)))
    except (ValueError, OverflowError) as error:
        assert_said(error)


# Queries that are valid and hard


@settings(max_examples=25, suppress_health_check=[*HealthCheck])  # pyright: ignore[reportArgumentType]
@given(
    center=st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    radius=st.floats(0.05, 5.0),
    obstacle=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.05, 4.0)),
    hard=st.booleans(),
    weight=st.sampled_from([0.0, 1e-6, 1.0, 1e6]),
)
def test_any_valid_query_ends_in_a_value_or_a_status(
    center: tuple, radius: float, obstacle: tuple, hard: bool, weight: float
) -> None:
    """Goals inside obstacles, goals that fill the box, walls around everything."""
    query = query_from_dict(
        {
            "model": "unicycle",
            "goal": {"center": list(center), "radius": radius},
            "obstacle": [
                {"shape": "circle", "center": list(obstacle[:2]), "radius": obstacle[2]}
                | {"hard": hard}
            ],
            "cost": {"obstacle": weight},
        }
    )
    try:
        solution = solve_eikonal(query, nodes=1500)
    except (SolveError, ValueError) as error:
        assert_said(error)
        return
    values = solution.value.on_grid.values
    assert not np.isnan(values).any()
    assert (values >= 0).all()


# What closed loops and grids are given


@MANY
@given(
    shares=st.tuples(NUMBERS, NUMBERS), noise=st.lists(NUMBERS, max_size=4),
    delay=st.integers(-3, 3), limit=NUMBERS,
)  # fmt: skip
def test_any_numbers_as_a_disturbance(shares: tuple, noise: list, delay: int, limit: Any) -> None:
    """Refused in words, or the loop ends in finite numbers."""
    query = SOLUTION.query
    try:
        disturbance = Disturbance(
            shares[0], shares[1], process=tuple(noise), delay=delay, limit=limit
        )
        loops = rollouts(
            SOLUTION.policy(),
            [[-4.0, -4.0, 0.0]],
            LoopSettings(period=0.1, time_limit=0.3),
            disturbance,
        )
    except (ValueError, OverflowError) as error:
        assert_said(error)
        return
    assert np.isfinite(loops[0].trajectory.inputs).all()
    assert loops[0].query == query
