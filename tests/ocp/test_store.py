"""The value store: what goes in comes out whole, damage is refused, nothing is done twice."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp.eikonal import solve_eikonal
from ocp.models import get_model
from ocp.obstacle import Obstacle
from ocp.oracle import consult
from ocp.query import Goal, Query
from ocp.query_family import PAPER_FAMILY, paper_query
from ocp.store import Filling, Store, fill, grid_value
from ocp.store_schema import SCHEMA, Order, Solved, StoreError
from ocp.store_solvers import SOLVERS, carry_out, order
from ocp.trajectory import SolveError, Status

NODES = {"nodes": 3000}


def some_orders(count: int) -> list[Order]:
    rng = np.random.default_rng(3)
    return [order(PAPER_FAMILY.sample(rng), "eikonal", NODES) for _ in range(count)]


def tiny(number: int = 0) -> tuple[Order, Solved]:
    """An order and a made-up answer, quick to write."""
    asked = Order({"model": "unicycle", "goal": {"number": number}}, "none", {"a": 1.5}, "code")
    arrays = {"value": (("x", "y"), np.arange(6.0).reshape(2, 3) + number)}
    return asked, Solved(arrays, Status.SOLVED, 0.01, 0.5, {"why": "ü"})


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Read only: tests that change it copy it."""
    store = Store(tmp_path_factory.mktemp("store") / "values")
    fill(store, some_orders(3))
    return store


@pytest.fixture
def copy(filled: Store, tmp_path: Path) -> Store:
    shutil.copytree(filled.folder, tmp_path / "copy")
    return Store(tmp_path / "copy")


# What goes in comes out


def test_an_entry_comes_back_as_it_went_in(tmp_path: Path) -> None:
    store = Store(tmp_path)
    asked, solved = tiny()
    entry = store.read(store.write(asked, solved))
    assert entry.order == asked
    assert entry.key == asked.key
    assert replace(entry.solved, arrays={}) == replace(solved, arrays={})
    assert entry.solved.arrays["value"][0] == ("x", "y")
    assert np.array_equal(entry.array("value"), solved.arrays["value"][1])


@pytest.mark.parametrize("special", [np.inf, np.nan, -0.0, 5e-324])
def test_special_numbers_survive(tmp_path: Path, special: float) -> None:
    store = Store(tmp_path)
    asked, solved = tiny()
    values = np.array([1.0, special, 3.0])
    entry = store.read(store.write(asked, replace(solved, arrays={"value": (("x",), values)})))
    assert entry.array("value").tobytes() == values.tobytes()


def test_a_stored_value_is_the_solvers(filled: Store) -> None:
    for asked in some_orders(3):
        entry = filled.get(asked)
        assert entry is not None
        solution = solve_eikonal(entry.query, nodes=3000)
        value = grid_value(entry)
        assert value.grid == solution.grid
        assert np.array_equal(value.on_grid.values, solution.value.on_grid.values)
        states = np.random.default_rng(0).uniform(-5, 5, (50, 3))
        assert np.array_equal(value.value(states), solution.value.value(states))


def test_it_is_plain_zarr_and_xarray(filled: Store) -> None:
    import xarray
    import zarr

    group: Any = zarr.open_group(filled.folder, mode="r")
    assert sorted(group.group_keys()) == list(filled)
    data = xarray.open_zarr(filled.folder / next(iter(filled)), consolidated=False, chunks=None)
    assert data["value"].dims == ("x", "y", "heading")
    assert data.attrs["status"] == "SOLVED"
    assert np.diff(data["x"].to_numpy()) == pytest.approx(10 / (data.sizes["x"] - 1))


@pytest.mark.parametrize("center", [(4.0, 4.0), (1.0, 4.0), (1.0, 1.0)])
@pytest.mark.parametrize("nodes", [4500, 18_000])
def test_the_error_estimate_is_of_the_errors_size(center: tuple, nodes: int) -> None:
    """Within a factor of two of the median error, held against a grid of many more nodes."""
    query = paper_query(center)
    solved = carry_out(order(query, "eikonal", {"nodes": nodes}))
    states = np.random.default_rng(5).uniform(query.system.lower, query.system.upper, (3000, 3))
    states = states[query.goal_distance(states) > 0]
    value = solve_eikonal(query, nodes=nodes).value.value(states)
    reference = solve_eikonal(query, nodes=240_000).value.value(states)
    error = np.median(np.abs(value / reference - 1))
    assert solved.error_estimate is not None
    assert error / 2 <= solved.error_estimate <= 2 * error


def test_exact_costs_are_established_ones(tmp_path: Path) -> None:
    store = Store(tmp_path)
    asked = order(paper_query((4.0, 4.0)), "exact", {"starts": 2, "seed": 1})
    fill(store, [asked])
    entry = store.get(asked)
    assert entry is not None
    for start, cost in zip(entry.array("start"), entry.array("cost"), strict=True):
        verdict = consult(entry.query, start)
        assert verdict.established == np.isfinite(cost)
        if verdict.established:
            assert cost == pytest.approx(verdict.value, rel=1e-4)


def test_a_solvers_own_failure_is_an_answer(tmp_path: Path) -> None:
    """Here that the scheme does not apply: told from the entry, not computed again."""
    store = Store(tmp_path)
    bounded = Query("unicycle", Goal((0.0, 0.0), 0.5), input_upper=(1.0, 1.0))
    asked = order(bounded, "eikonal", {**NODES, "scheme": "FAST_MARCHING"})
    first, second = fill(store, [asked]), fill(store, [asked])
    assert first.unsolved == {asked.key: Status.NOT_APPLICABLE}
    assert (first.computed, second.present) == ([asked.key], [asked.key])
    entry = store.get(asked)
    assert entry is not None
    assert entry.solved.status is Status.NOT_APPLICABLE
    with pytest.raises(SolveError) as caught:
        grid_value(entry)
    assert caught.value.status is Status.NOT_APPLICABLE


# Keys


def test_equal_queries_have_equal_keys() -> None:
    a = Query("unicycle", Goal((1, 2), 0.5), (Obstacle.circle((0, 0), 1),))
    b = Query("unicycle", Goal((1.0, 2.0), 0.5), (Obstacle.circle((0.0, 0.0), 1.0),))
    assert order(a, "eikonal").key == order(b, "eikonal").key


def test_whatever_changes_the_numbers_changes_the_key() -> None:
    query = paper_query((4.0, 4.0))
    base = order(query, "eikonal")
    others = [
        order(paper_query((4.0, 4.1)), "eikonal"),
        order(replace(query, robot_radius=0.1), "eikonal"),
        order(query, "exact"),
        order(query, "eikonal", {"nodes": 1000}),
        replace(base, code_version="another"),
    ]
    assert len({base.key, *(o.key for o in others)}) == 1 + len(others)


@given(st.text(max_size=20))
def test_a_key_that_is_none_is_refused(filled: Store, text: str) -> None:
    with pytest.raises(StoreError):
        filled.read(text)


def test_wrong_orders_are_refused_before_work() -> None:
    query = paper_query((4.0, 4.0))
    with pytest.raises(ValueError, match="solver: 'magic'"):
        order(query, "magic")
    with pytest.raises(ValueError, match=r"eikonal\.colour"):
        order(query, "eikonal", {"colour": 1})
    own = replace(query, model=get_model("unicycle"))
    with pytest.raises(ValueError, match="model"):
        order(own, "eikonal")
    assert set(SOLVERS) == {"eikonal", "exact"}


def test_other_sources_do_not_answer() -> None:
    """A worker with other sources than the order's refuses: it would mislabel its numbers."""
    asked = replace(order(paper_query((4.0, 4.0)), "eikonal", NODES), code_version="older")
    with pytest.raises(ValueError, match="code_version"):
        carry_out(asked)


# Damage


@settings(max_examples=60)
@given(data=st.data())
def test_a_flipped_bit_is_never_read(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whichever bit of whichever file: refused, or (blanks in the metadata) the same entry."""
    store = Store(tmp_path_factory.mktemp("flip"))
    asked, solved = tiny()
    folder = store.folder / store.write(asked, solved)
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    path = data.draw(st.sampled_from(files))
    content = bytearray(path.read_bytes())
    bit = data.draw(st.integers(0, 8 * len(content) - 1))
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)
    try:
        entry = store.read(asked.key)
    except StoreError:
        return
    assert path.name == "zarr.json"
    assert entry.order == asked
    assert np.array_equal(entry.array("value"), solved.arrays["value"][1])


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_a_truncated_file_is_refused(copy: Store, keep: float) -> None:
    key = next(iter(copy))
    for path in sorted(p for p in (copy.folder / key).rglob("*") if p.is_file()):
        content = path.read_bytes()
        path.write_bytes(content[: int(keep * len(content))])
        assert copy.verify(key) is not None
        with pytest.raises(StoreError, match=key):
            copy.read(key)
        path.write_bytes(content)
    assert copy.verify(key) is None


def test_missing_foreign_and_linked_files_are_refused(copy: Store, tmp_path: Path) -> None:
    first, second, third = copy
    chunk = next(p for p in (copy.folder / first / "value" / "c").rglob("*") if p.is_file())
    chunk.unlink()
    (copy.folder / second / "value" / "extra").write_text("?")
    (tmp_path / "elsewhere").write_text("secret")
    (copy.folder / third / "x" / "link").symlink_to(tmp_path / "elsewhere")
    for key, word in ((first, "missing"), (second, "not among"), (third, "link")):
        with pytest.raises(StoreError, match=word):
            copy.read(key)


def test_an_entry_under_anothers_key_is_refused(copy: Store) -> None:
    first, second = list(copy)[:2]
    shutil.rmtree(copy.folder / first)
    (copy.folder / second).rename(copy.folder / first)
    with pytest.raises(StoreError, match="key"):
        copy.read(first)


def test_a_codec_that_could_run_code_is_refused(tmp_path: Path) -> None:
    """Even with hashes that fit: someone may have made it on purpose."""
    from ocp.store_schema import seal

    store = Store(tmp_path)
    asked, solved = tiny()
    folder = store.folder / store.write(asked, solved)
    path = folder / "value" / "zarr.json"
    table = json.loads(path.read_text())
    table["codecs"].append({"name": "numcodecs.pickle", "configuration": {}})
    path.write_text(json.dumps(table))
    group = folder / "zarr.json"
    attributes = json.loads(group.read_text())
    attributes["attributes"].pop("digest")
    group.write_text(json.dumps(attributes))
    seal(folder)
    with pytest.raises(StoreError, match=r"codec numcodecs\.pickle"):
        store.read(asked.key)


def test_damaged_entries_are_computed_anew(copy: Store) -> None:
    key = list(copy)[1]
    chunk = next(p for p in (copy.folder / key / "value" / "c").rglob("*") if p.is_file())
    before = hashlib.sha256(chunk.read_bytes()).hexdigest()
    chunk.write_bytes(b"\0" + chunk.read_bytes()[1:])
    filling = fill(copy, some_orders(3))
    assert list(filling.replaced) == filling.computed == [key]
    assert len(filling.present) == 2
    assert all(copy.verify(k) is None for k in copy)
    chunk = next(p for p in (copy.folder / key / "value" / "c").rglob("*") if p.is_file())
    assert hashlib.sha256(chunk.read_bytes()).hexdigest() == before


# Filling and merging


def test_only_what_is_missing_is_computed(copy: Store) -> None:
    told: list[tuple[int, int]] = []

    def notify(filling: Filling) -> None:
        told.append((len(filling.present), len(filling.computed)))

    orders = some_orders(4)
    shutil.rmtree(copy.folder / orders[1].key)
    filling = fill(copy, [*orders, *orders], notify=notify)
    assert filling.computed == [orders[1].key, orders[3].key]
    assert sorted(filling.present) == sorted([orders[0].key, orders[2].key])
    assert [computed for _, computed in told] == [1, 2]
    assert fill(copy, orders).computed == []


def test_a_task_that_fails_is_told_and_the_rest_stored(tmp_path: Path) -> None:
    bad = replace(some_orders(1)[0], code_version="older")
    filling = fill(Store(tmp_path), [bad, *some_orders(1)])
    assert list(filling.failed) == [bad.key]
    assert "code_version" in filling.failed[bad.key].message
    assert filling.computed == [some_orders(1)[0].key]


def test_merge_takes_what_is_sound_and_new(filled: Store, copy: Store, tmp_path: Path) -> None:
    first, second, third = copy
    (copy.folder / first / "x" / "zarr.json").write_text("{}")
    target = Store(tmp_path / "target")
    shutil.copytree(filled.folder / second, target.folder / second)
    merge = target.merge(copy)
    assert (merge.copied, merge.present, list(merge.damaged)) == ([third], [second], [first])
    assert list(target) == sorted([second, third])
    assert np.array_equal(target.read(third).array("value"), filled.read(third).array("value"))
    assert target.merge(filled).copied == [first]


# Folders that are no stores


def test_the_store_of_another_schema_is_refused(tmp_path: Path) -> None:
    Store(tmp_path)
    for schema, word in ((SCHEMA + 1, "newer"), (0, "another"), ("x", "another")):
        table = {"zarr_format": 3, "node_type": "group", "attributes": {"zermelo_store": schema}}
        (tmp_path / "zarr.json").write_text(json.dumps(table))
        with pytest.raises(StoreError, match=word):
            Store(tmp_path)
    for text in ("", "[]", "{}", '{"attributes": {}}', "\0"):
        (tmp_path / "zarr.json").write_text(text)
        with pytest.raises(StoreError, match="no store"):
            Store(tmp_path)


def test_other_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(StoreError, match="neither empty nor a store"):
        Store(tmp_path)
    with pytest.raises(StoreError, match="no store"):
        Store(tmp_path / "new", create=False)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
