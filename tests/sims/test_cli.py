"""The command line: what it prints, how it ends, what it refuses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from references import TABLE_ONE_OPTIMA

from ocp.query import Query
from ocp.query_family import PAPER_GOALS, paper_query
from sims.cli import main
from sims.methods import METHODS

QUERIES = Path(__file__).resolve().parents[2] / "sims" / "queries"
START = ["--start", "-4", "-4", "-0.7853981633974483"]

LARGEST_EXCESS = {"set-valued": 0.06, "interpolation": 0.02, "mpc": 0.21, "trpo": 0.17}
"""From START to (4, 4); MPC and TRPO: those of the paper. Others: 0.4 %."""


def zermelo(capsys, monkeypatch, *arguments: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["zermelo", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    captured = capsys.readouterr()
    return int(end.value.code or 0), captured.out, captured.err


@pytest.fixture
def run(capsys, monkeypatch):
    return lambda *arguments: zermelo(capsys, monkeypatch, *arguments)


@pytest.mark.parametrize("goal", PAPER_GOALS)
def test_the_shipped_queries_are_the_papers(goal) -> None:
    path = QUERIES / "paper-{:g}-{:g}.toml".format(*goal)
    assert Query.load(path) == paper_query(goal)


FOR_EQUILIBRIA = {"causality-free", "value-iteration"}


@pytest.mark.parametrize("method", sorted(FOR_EQUILIBRIA))
def test_a_method_for_other_goals_says_so(method: str, run) -> None:
    status, _, err = run("plan", str(QUERIES / "paper-4-4.toml"), *START, "--method", method)
    assert status == 3
    assert method in err


@pytest.mark.parametrize("method", sorted(METHODS.keys() - FOR_EQUILIBRIA))
def test_plan_prints_one_json_document(method: str, run) -> None:
    status, out, _ = run(
        "plan", str(QUERIES / "paper-4-4.toml"), *START, "--method", method, "--json"
    )
    assert status == 0
    document = json.loads(out)
    assert set(document) == {"query", "method", "reaction_time_s", "trajectories", "starts"}
    assert document["method"] == method
    assert document["reaction_time_s"] > 0
    (start,) = document["starts"]
    assert set(start) == {
        "start",
        "value",
        "cost",
        "exact_cost",
        "excess",
        "reached",
        "collided",
        "min_clearance",
    }
    assert start["reached"] is True
    assert start["collided"] is False
    assert start["min_clearance"] is None  # no obstacle: no number, never NaN or infinity
    assert start["exact_cost"] == pytest.approx(TABLE_ONE_OPTIMA[4.0, 4.0], abs=5e-5)
    assert start["excess"] == pytest.approx(start["cost"] / start["exact_cost"] - 1)
    # No closed loop beats the optimum by more than what the goal's tolerance of 1 mm is worth.
    assert -1e-4 < start["excess"] < LARGEST_EXCESS.get(method, 0.004)


def test_several_starts_without_the_exact_optimum(run) -> None:
    status, out, _ = run(
        "plan",
        str(QUERIES / "paper-1-1.toml"),
        *START,
        "--start",
        "3",
        "-2",
        "1e-1",
        "--no-exact",
        "--json",
    )
    assert status == 0
    starts = json.loads(out)["starts"]
    assert [s["start"] for s in starts] == [[-4, -4, -np.pi / 4], [3, -2, 0.1]]
    assert all(s["exact_cost"] is None and s["excess"] is None for s in starts)
    assert all(s["min_clearance"] is not None for s in starts)


def test_plan_writes_a_figure_and_data(run, tmp_path: Path) -> None:
    out = tmp_path / "made" / "here"
    status, text, _ = run("plan", str(QUERIES / "paper-1-4.toml"), *START, "--out", str(out))
    assert status == 0
    assert "exact cost" in text
    assert {p.name for p in out.iterdir()} == {"plan.json", "plan.png", "trajectories.npz"}
    with np.load(out / "trajectories.npz", allow_pickle=False) as data:
        loop = data["closed_loop_0_states"]
        cost = data["closed_loop_0_cost_so_far"]
        exact = data["exact_0_cost_so_far"]
    document = json.loads((out / "plan.json").read_text())
    np.testing.assert_allclose(loop[0], document["starts"][0]["start"])
    assert cost[-1] == document["starts"][0]["cost"]
    assert exact[-1] == document["starts"][0]["exact_cost"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.toml", *START], "nowhere.toml"),
        (["paper-4-4.toml"], "start: give at least one"),
        (["paper-4-4.toml", "--start", "1", "2"], "start: unicycle needs 3 numbers"),
        (["paper-4-4.toml", "--start", "9", "2", "0"], "start: x = 9 m lies outside [-5, 5]"),
        (["paper-4-4.toml", "--start", "nan", "2", "0"], "start: numbers must be finite"),
        (["paper-4-4.toml", *START, "--method", "magic"], "method: 'magic' is unknown; known are"),
        (["paper-4-4.toml", *START, "--deadline", "-1"], "deadline: must be a positive number"),
        (["paper-4-4.toml", *START, "--trajectories", "0"], "trajectories: must be at least 1"),
    ],
)
def test_bad_input_ends_in_status_2_and_names_the_field(arguments, message, run) -> None:
    status, out, err = run("plan", str(QUERIES / arguments[0]), *arguments[1:])
    assert status == 2
    assert message in err
    assert out == ""


def test_a_reader_that_stops_reading_gets_no_traceback() -> None:
    """As `zermelo bench --help | head -1`."""
    command = subprocess.Popen(
        [sys.executable, "-c", "from sims.cli import main; main()", "bench", "--help"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    assert command.stdout is not None
    assert command.stderr is not None
    command.stdout.close()
    assert command.stderr.read() == b""
    assert command.wait() == 141


def test_an_output_folder_that_cannot_be_made_is_refused_first(run, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.touch()
    status, _, err = run(
        "plan", str(QUERIES / "paper-4-4.toml"), *START, "--out", str(blocked / "out")
    )
    assert status == 2
    assert str(blocked) in err


def test_a_goal_walled_in_is_unsolved(run, tmp_path: Path) -> None:
    """A ring of hard walls: no method reaches it, the command says so and ends in status 3."""
    walls = [
        [(2, 2), (6, 2), (6, 2.4), (2, 2.4)],
        [(2, 5.6), (6, 5.6), (6, 6), (2, 6)],
        [(2, 2), (2.4, 2), (2.4, 6), (2, 6)],
        [(5.6, 2), (6, 2), (6, 6), (5.6, 6)],
    ]
    text = 'model = "unicycle"\n[goal]\ncenter = [4.0, 4.0]\nradius = 0.5\n'
    for wall in walls:
        shifted = [[float(x), float(y)] for x, y in wall]
        text += f'[[obstacle]]\nshape = "polygon"\nvertices = {shifted}\nhard = true\n'
    path = tmp_path / "walled.toml"
    path.write_text(text)
    status, out, _ = run("plan", str(path), *START, "--json")
    assert status == 3
    if out:
        (start,) = json.loads(out)["starts"]
        assert start["reached"] is False
        assert start["cost"] is None
        assert start["exact_cost"] is None


def test_unknown_demos_and_benchmarks_say_what_exists(run) -> None:
    status, _, err = run("demo", "juggling")
    assert status == 2
    assert "four-queries" in err
    status, _, err = run("bench", "juggling")
    assert status == 2
    assert "exact" in err


def test_regulate_prints_one_json_document(run, tmp_path: Path) -> None:
    system = QUERIES.parent / "systems" / "double-integrator-1d.toml"
    status, out, _ = run("regulate", str(system), "--json", "--out", str(tmp_path))
    assert status == 0
    document = json.loads(out)
    assert set(document) == {
        "learner",
        "gain_error",
        "cost",
        "optimal_cost",
        "excess",
        "data_seconds",
        "rank",
        "required_rank",
        "update_time_s",
        "converged",
    }
    assert document["converged"] is True
    assert document["gain_error"] < 1e-4
    assert abs(document["excess"]) < 1e-5
    assert (tmp_path / "regulate.png").exists()


def test_regulate_refuses_bad_input(run, tmp_path: Path) -> None:
    path = tmp_path / "system.toml"
    good = (QUERIES.parent / "systems" / "double-integrator-1d.toml").read_text()
    path.write_text(good.replace("horizon", "horizons"))
    status, out, err = run("regulate", str(path))
    assert (status, out) == (2, "")
    assert "horizons" in err
    status, _, err = run("regulate", str(path), "--learner", "magic")
    assert status == 2
    assert "learner: 'magic' is unknown; known are q-learning" in err


@pytest.mark.parametrize("command", ["plan", "demo", "regulate", "bench"])
def test_every_command_has_help_and_the_common_options(command: str, run) -> None:
    status, out, _ = run(command, "--help")
    assert status == 0
    for option in ("--seed", "--out", "--json"):
        assert option in out
