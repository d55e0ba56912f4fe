"""The experiments: resumable, honest about what is absent, their numbers held against the truth."""

import json
import math
from pathlib import Path

import pytest
from references import TABLE_ONE_OPTIMA

from ocp.planning import OneShot
from ocp.trajectory import SolveError, Status
from sims.commands import reproduce
from sims.experiments import EXPERIMENTS, Setting, experiment, fig2, fig3, table1
from sims.experiments import ledger as ledgers
from sims.experiments.contestants import CONTESTANTS, NEVER, Contestant, contestant
from sims.experiments.paper import GOALS, TABLE_I
from sims.parts import Parts


def fails(_query, _starts):
    raise SolveError(Status.NOT_CONVERGED, "on purpose")


FEW = (
    contestant("eikonal"),
    Contestant("nobody", "MPC", "not-yet-made", lambda: OneShot(fails), NEVER, "MPC"),
    Contestant("loser", "loses", "", lambda: OneShot(fails), NEVER),
    contestant("trpo-alone"),
)


@pytest.fixture(scope="module")
def few(tmp_path_factory) -> tuple[Path, dict]:
    """Table I: one that works, one that does not exist, one that fails, one for a single goal."""
    out = tmp_path_factory.mktemp("reproduced")
    with pytest.MonkeyPatch.context() as patch:
        rows = {c.row: c for c in CONTESTANTS if c.row} | {"MPC": FEW[1]}
        hidden = [
            Contestant(c.key, c.label, "not-yet-made", c.planner, NEVER, c.row)
            for c in rows.values()
        ]
        patch.setattr(table1, "CONTESTANTS", (*hidden, FEW[0], *FEW[2:]))
        document = reproduce.reproduce("table1", Setting(True, 0, out))
    return out, document


def test_every_experiment_is_a_module_with_all_it_needs() -> None:
    for name in EXPERIMENTS:
        module = experiment(name)
        assert all(callable(getattr(module, part)) for part in ("run", "draw", "entries"))


def test_the_optima_are_the_known_ones(few) -> None:
    _, document = few
    for goal, optimum in zip(GOALS, document["findings"]["optima"], strict=True):
        assert optimum == pytest.approx(TABLE_ONE_OPTIMA[goal], rel=2e-5)


def test_what_exists_is_measured_and_what_does_not_is_absent(few) -> None:
    rows = {r["key"]: r for r in few[1]["findings"]["rows"]}
    for goal, cost in zip(GOALS, rows["eikonal"]["costs"], strict=True):
        assert -1e-4 < cost / TABLE_ONE_OPTIMA[goal] - 1 < 0.004
    assert rows["nobody"]["costs"] == [None] * 4
    assert rows["nobody"]["absent"] == "not-yet-made is not implemented"
    assert rows["loser"]["absent"] is None
    assert rows["loser"]["costs"] == [None] * 4
    assert "on purpose" in rows["loser"]["failures"][0]


def test_trained_for_one_query_trpo_is_cheaper_there_than_the_papers(few) -> None:
    """The one query on which the policy for the whole family is dearer."""
    row = next(r for r in few[1]["findings"]["rows"] if r["key"] == "trpo-alone")
    k = GOALS.index((1.0, 1.0))
    assert TABLE_ONE_OPTIMA[GOALS[k]] < row["costs"][k] < TABLE_I["TRPO"][k]
    assert [cost is None for cost in row["costs"]] == [i != k for i in range(4)]
    line = next(x for x in (few[0] / "table1.md").read_text().splitlines() if row["label"] in x)
    assert line.split("|")[2 + k].strip() == f"{row['costs'][k]:.2f}"
    assert line.count("| - ") == 4


def test_tables_figures_and_environment_are_written(few) -> None:
    out, document = few
    assert {"machine", "code", "seed", "quick", "seconds"} <= set(document)
    for name in ("table1.md", "table1.csv", "table1.png", "table1.svg", "table1.json"):
        assert (out / name).stat().st_size > 0
    text = (out / "table1.md").read_text()
    assert "| MPC | absent [21.9] |" in text
    assert "15.577" in text


def test_the_ledger_has_a_line_for_every_number_of_the_table(few) -> None:
    out, _ = few
    sheet = ledgers.ledger(out)
    where = [row[0] for row in sheet.rows]
    for row in TABLE_I:
        assert sum(w.startswith(f"Table I, {row}, goal") for w in where) == 4
    swapped = {r[0]: r for r in sheet.rows if "ReFMM (fine grid): mean" in r[0]}
    (line,) = swapped.values()
    assert line[1:3] == ("4 %", "0.25 %")
    assert "swapped" in line[5]
    benchmark = [r for r in sheet.rows if "benchmark itself" in r[0]]
    assert [r[2].split()[0] for r in benchmark] == ["11.1", "5.17", "3.01", "5.17"]
    assert any(note.startswith("fig3: not run") for note in sheet.notes)


def test_the_ledger_leaves_out_what_an_older_version_wrote(few, tmp_path) -> None:
    _, document = few
    rows = [{k: v for k, v in r.items() if k != "costs"} for r in document["findings"]["rows"]]
    old = {**document, "findings": {**document["findings"], "rows": rows}}
    (tmp_path / "table1.json").write_text(json.dumps(old))
    sheet = ledgers.ledger(tmp_path)
    assert not sheet.rows
    assert "table1: by an older version, without 'costs'; run it again." in sheet.notes


def test_a_second_run_measures_nothing_again(few, monkeypatch) -> None:
    out, document = few
    monkeypatch.setattr(table1, "CONTESTANTS", (FEW[0],))
    parts = Parts(out / "parts", {"seed": 0, "quick": True})

    def forbidden(*_arguments) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr("sims.experiments.measure.judged", forbidden)
    monkeypatch.setattr("sims.experiments.measure.consult", forbidden)
    again = table1.run(Setting(True, 0, out), parts).document
    before = [r for r in document["findings"]["rows"] if r["key"] == "eikonal"]
    assert again["rows"] == before


def test_figure_two_counts_from_when_the_excess_stays() -> None:
    points = [
        {"seconds": 1.0, "ratio": None},
        {"seconds": 2.0, "ratio": 1.04},
        {"seconds": 3.0, "ratio": 1.2},
        {"seconds": 4.0, "ratio": 1.03},
        {"seconds": 5.0, "ratio": 1.01},
    ]
    assert fig2.first(points, 1.05) == 4.0
    assert fig2.first(points) == 2.0
    assert fig2.first(points, 1.001) is None
    assert fig2.first([], math.inf) is None


def test_figure_three_counts_a_query_without_a_plan_as_not_reached() -> None:
    good = {
        "n": 2,
        "failure": None,
        "seconds": 1.0,
        "reached": 0.9,
        "excess": 0.1,
        "value_error": 0.2,
    }
    bad = {"n": 2, "failure": "diverged"}
    (row,) = fig3.averages([{"rows": [good]}, {"rows": [bad]}])
    assert row["reached"] == pytest.approx(0.45)
    assert row["excess"] == pytest.approx(0.1)


def test_contestants_keys_are_unique_and_cover_the_papers_rows() -> None:
    keys = [c.key for c in CONTESTANTS]
    assert len(set(keys)) == len(keys)
    assert {c.row for c in CONTESTANTS if c.row} == set(TABLE_I)


def test_documents_hold_no_nan(few) -> None:
    text = (few[0] / "table1.json").read_text()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in table1.json"))
