"""Results held against each other: moves are told, noise is not, a slower machine is no change."""

import json
from pathlib import Path
from typing import Any

import pytest

from sims.commands.bench_compare import FIGURE_NOISE, TIME_NOISE, load, moves, reference_seconds


def result(reference: float = 0.01, **figures: Any) -> dict[str, Any]:
    return {"reference_s": reference, "benchmarks": {"grids": figures}}


def names(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    return [move.name for move in moves(before, after)]


def test_equal_results_have_no_moves() -> None:
    same = result(solve_s=0.02, rows=[{"error": 0.01, "name": "a"}], done=True)
    assert moves(same, same) == []


def test_only_what_exceeds_the_noise_moves() -> None:
    for key, noise in (("solve_s", TIME_NOISE), ("error", FIGURE_NOISE)):
        before = result(**{key: 1.0})
        assert names(before, result(**{key: 1.0 + 0.9 * noise})) == []
        assert names(before, result(**{key: 1.0 / (1.0 - 1.1 * noise)})) == [f"grids.{key}"]


def test_a_machine_of_half_the_pace_doubles_times_and_nothing_else() -> None:
    before, after = result(0.01, solve_s=1.0, error=1.0), result(0.02, solve_s=2.0, error=2.0)
    assert names(before, after) == ["grids.error"]
    (move,) = moves(before, result(0.02, solve_s=1.0, error=1.0))
    assert move.ratio == pytest.approx(0.5)


def test_figures_that_one_result_lacks_are_told_and_other_benchmarks_are_not() -> None:
    before, after = result(old=1.0), result(new=1.0)
    after["benchmarks"]["rrtx"] = {"x": 1.0}
    assert names(before, after) == ["grids.new", "grids.old"]


def test_rounding_does_not_move() -> None:
    assert names(result(error=1e-13), result(error=9e-13)) == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"benchmarks": 3}', "\0"])
def test_a_file_that_is_no_result_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bench.json"
    path.write_text(text)
    with pytest.raises(ValueError, match="no result of zermelo bench"):
        load(path)


def test_a_result_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    path.write_text(json.dumps(result(x=1.0)))
    assert load(path) == result(x=1.0)
    assert reference_seconds(3) > 0


def test_a_repeated_figure_is_held_against_its_own_spread() -> None:
    """Three times both spreads, and a twentieth at least; the spread itself is no figure."""

    def repeated(median: float, spread: float) -> dict[str, Any]:
        return result(grid={"over_reference": median, "spread": spread})

    assert names(repeated(1.0, 0.02), repeated(1.12, 0.02)) == []
    assert names(repeated(1.0, 0.02), repeated(1.15, 0.02)) == ["grids.grid.over_reference"]
    assert names(repeated(1.0, 0.001), repeated(1.04, 0.001)) == []
    assert names(repeated(1.0, 0.001), repeated(1.07, 0.001)) == ["grids.grid.over_reference"]
    assert names(repeated(1.0, 0.001), repeated(1.0, 0.2)) == []
