"""Table III: the set-valued method on a grid against exact trajectories, time and error a state."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from ocp.pontryagin import exact_trajectory
from ocp.query_family import PAPER_FAMILY, sample_start
from ocp.set_valued import Method, solve_set_valued
from ocp.trajectory import SolveError, Trajectory
from sims.experiments import Entry, Findings, Setting
from sims.experiments.generation import SAMPLES
from sims.experiments.paper import TABLE_III
from sims.experiments.sheet import Sheet, percent, seconds
from sims.parts import Parts

TRAJECTORIES = 8


def run(setting: Setting, parts: Parts) -> Findings:
    """Both methods on fresh queries; the grid's values judged at the trajectories' states."""
    queries = 2 if setting.quick else 10
    rows = [parts.get(f"table3-{k}", {}, lambda k=k: _one(setting.seed, k)) for k in range(queries)]
    document = {"rows": rows}
    return Findings(document, {"table3": sheet(document)})


def _one(seed: int, k: int) -> dict[str, Any]:
    rng = np.random.default_rng([seed, 3, k])
    query = PAPER_FAMILY.sample(rng)
    solve_set_valued(query)
    begun = time.process_time()
    solution = solve_set_valued(query)
    label_setting = time.process_time() - begun
    begun = time.process_time()
    solve_set_valued(query, method=Method.JACOBI)
    jacobi = time.process_time() - begun
    exact_trajectory(query, sample_start(query, rng))
    motions: list[Trajectory] = []
    spent, failed = 0.0, 0
    while len(motions) < TRAJECTORIES:
        start = sample_start(query, rng)
        begun = time.process_time()
        try:
            motions.append(exact_trajectory(query, start))
        except SolveError:
            failed += 1
        spent += time.process_time() - begun
    states, values = zip(*(_sampled(m) for m in motions), strict=True)
    states, values = np.concatenate(states), np.concatenate(values)
    outside = query.goal_distance(states) > 0.1
    found = np.asarray(solution.value.value(states))
    known = outside & np.isfinite(found)
    errors = np.abs(found[known] / values[known] - 1)
    return {
        "states": solution.value.values.size,
        "label_setting_seconds": label_setting,
        "jacobi_seconds": jacobi,
        "trajectory_seconds": spent,
        "trajectory_states": len(states),
        "failed": failed,
        "median_error": float(np.median(errors)),
        "error_95": float(np.quantile(errors, 0.95)),
    }


def _sampled(motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """`SAMPLES` states at even times, and their exact cost-to-go."""
    times = np.linspace(0.0, motion.duration, SAMPLES, endpoint=False)
    states = [np.interp(times, motion.times, column) for column in motion.states.T]
    return np.stack(states, axis=-1), np.interp(times, motion.times, motion.cost_to_go)


def _median(document: dict[str, Any], key: str) -> float:
    return float(np.median([row[key] for row in document["rows"]]))


def sheet(document: dict[str, Any]) -> Sheet:
    """Ours beside the paper's."""
    result = Sheet(
        "Table III: two ways to optimal values; processor time, in brackets the paper's",
        ("approach", "time a state", "states", "total", "median value error", "95 %"),
    )
    nodes, states = (int(_median(document, key)) for key in ("states", "trajectory_states"))
    rows = (
        ("Set-valued method, value iteration", "jacobi_seconds", nodes, "Set-valued method"),
        ("Set-valued method, label setting", "label_setting_seconds", nodes, None),
        ("Exact trajectories", "trajectory_seconds", states, "Causality-free method"),
    )
    for label, key, count, paper in rows:
        total = _median(document, key)
        claim = TABLE_III[paper] if paper else (None, None, None)
        errors = ("0 (truth)", "0") if key == "trajectory_seconds" else None
        errors = errors or (
            percent(_median(document, "median_error")),
            percent(_median(document, "error_95")),
        )
        result.add(
            label,
            f"{seconds(total / count)} [{seconds(claim[0])}]",
            f"{count:,} [{'-' if claim[1] is None else f'{claim[1]:,}'}]",
            f"{seconds(total)} [{seconds(claim[2])}]",
            *errors,
        )
    result.notes = [
        f"Median of {len(document['rows'])} fresh queries. The grid's values (nearest-node image) "
        "are judged at the trajectories' states, more than 0.1 m from the goal."
    ]
    return result


def draw(document: dict[str, Any], out: Path) -> list[Path]:  # noqa: ARG001
    """No figure: the table says it all."""
    return []


def entries(document: dict[str, Any]) -> list[Entry]:
    """One for each figure of the table."""
    nodes, states = (_median(document, key) for key in ("states", "trajectory_states"))
    totals = {
        "Set-valued method": (_median(document, "jacobi_seconds"), nodes),
        "Causality-free method": (_median(document, "trajectory_seconds"), states),
    }
    found = []
    for row, (per_state, count, total) in TABLE_III.items():
        ours, size = totals[row]
        recomputed = f"{per_state * count:.3g} s" if row != "Set-valued method" else "271 s"
        remark = "Value iteration as printed; label setting needs " + seconds(
            _median(document, "label_setting_seconds")
        )
        if row == "Causality-free method":
            remark = (
                "Table II gives 6.8 s for the same eight trajectories; here a coarse grid for the "
                "first guess is solved for each and counted"
            )
        found.append(
            Entry(
                f"Table III, {row}, total",
                seconds(total),
                recomputed,
                seconds(ours),
                "-",
                remark + ".",
            )
        )
        found.append(
            Entry(f"Table III, {row}, a state", seconds(per_state), "-", seconds(ours / size))
        )
    error = percent(_median(document, "median_error"))
    found.append(
        Entry(
            "Section IV-D: the set-valued method's error at the 256 states is too large",
            "no figure",
            ours=f"{error} median",
            optimum="0 %",
            remark="The nearest-node reading of eq. (7) on the coarse grid.",
        )
    )
    return found
