"""`zermelo plan`: a policy for a query, its closed loops, and the exact optimum beside them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ocp.execution import completed, open_door
from ocp.files import atomic_path, write_text
from ocp.planning import Plan, deadline, plan, trajectories
from ocp.pontryagin import ExactValue
from ocp.query import Query
from ocp.query_file import query_from_dict, query_to_dict
from ocp.trajectory import SolveError, Trajectory
from sims.closed_loop import LoopSettings, Rollout, rollouts
from sims.exit_status import UNSOLVED, reading_input
from sims.methods import METHODS, default_method

if TYPE_CHECKING:
    from sims import cli

notes = Console(stderr=True)

MOST_NAMED = 3  # states that a column's head has room for
MOST_MAPPED = 3  # states of a robot whose V is drawn over the plane


@dataclass(frozen=True)
class Outcome:
    """What became of one start.

    Attributes:
        value: the method's V at the start; infinite or NaN values are not reported.
        rollout: the closed loop.
        exact: the exact optimal motion, or `None` where it was not asked for or not established.
        why_not: why there is no exact motion, if it was asked for.
    """

    value: float
    rollout: Rollout
    exact: Trajectory | None
    why_not: str | None = None

    @property
    def excess(self) -> float | None:
        """Closed-loop cost over the exact optimum, minus 1."""
        if self.exact is None or self.rollout.cost is None or self.exact.cost == 0:
            return None
        return self.rollout.cost / self.exact.cost - 1

    def report(self) -> dict[str, Any]:
        """The start's entry in the JSON document."""
        return {
            "start": self.rollout.start.tolist(),
            "value": _finite(self.value),
            "cost": self.rollout.cost,
            "exact_cost": None if self.exact is None else self.exact.cost,
            "excess": self.excess,
            "reached": self.rollout.reached,
            "collided": self.rollout.collided,
            "min_clearance": _finite(self.rollout.min_clearance),
        }


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None


def solve(
    query: Query,
    starts: list[NDArray[np.float64]],
    method: str,
    *,
    seconds: float | None = None,
    count: int | None = None,
    with_exact: bool = True,
    cluster: str | None = None,
) -> tuple[Plan, list[Outcome]]:
    """Plan, close the loop from every start, and find the exact optimum beside each.

    With the address of a Dask `cluster` the optima are found there, all starts at once.

    Raises:
        SolveError: if the method found no policy.
    """
    chosen = METHODS[method]
    chosen.rehearse(query, seconds)
    until = trajectories(8 if count is None and seconds is None else count or 10**9)
    if seconds is not None:
        until = until | deadline(seconds)
    answer = plan(chosen.planner_for(seconds), query, starts, until)
    loops = rollouts(answer.policy, starts, LoopSettings(period=chosen.period))
    values = [float(np.asarray(answer.value.value(start))) for start in starts]
    wanted = [k for k, value in enumerate(values) if with_exact and np.isfinite(value)]
    optima = dict(zip(wanted, _optima(query, [starts[k] for k in wanted], cluster), strict=True))
    none = f"{method} found no admissible motion, so none was looked for" if with_exact else None
    outcomes = [
        Outcome(value, loop, *optima.get(k, (None, none)))
        for k, (value, loop) in enumerate(zip(values, loops, strict=True))
    ]
    return answer, outcomes


Optimum = tuple[Trajectory | None, str | None]


def _optima(query: Query, starts: list[NDArray], cluster: str | None) -> list[Optimum]:
    """The optimal motion from each start, or why there is none."""
    with notes.status("exact optimum") as status:
        if cluster is None:
            found = []
            for k, start in enumerate(starts, 1):
                status.update(f"exact optimum {k} of {len(starts)}")
                found.append(_exact(query, start))
            return found
        table = query_to_dict(query)
        optima: list[Optimum] = [(None, "the cluster gave no answer")] * len(starts)
        with open_door(cluster=cluster) as door:
            tasks = [(table, start.tolist()) for start in starts]
            for outcome in completed(door, exact_from, tasks):
                failed = outcome.failure
                optima[outcome.index] = (None, failed.message) if failed else outcome.answer
        return optima


def exact_from(task: tuple[dict[str, Any], list[float]]) -> Optimum:
    """A worker's share: the optimum of a query (as a table) from a start `[n]`."""
    table, start = task
    return _exact(query_from_dict(table), np.array(start))


def _exact(query: Query, start: NDArray) -> Optimum:
    """The optimal motion if it counts as truth, else why it does not."""
    from ocp.oracle import consult

    verdict = consult(query, start)
    return (verdict.best, None) if verdict.established else (None, verdict.explanation)


def run(command: "cli.Plan") -> int:
    """Run the command; returns its exit status."""
    with reading_input():
        query = Query.load(command.query)
        method, reason = (command.method, None) if command.method else default_method(query)
        if method not in METHODS:
            known = ", ".join(METHODS)
            raise ValueError(f"method: {method!r} is unknown; known are {known}")
        if not command.start:
            raise ValueError("start: give at least one, --start X1 X2 ...")
        starts = [query.check_start(s) for s in command.start]
        if query.is_regulation:
            from ocp.regulation import regulator

            regulator(query)  # whether the equilibrium can be stabilised at all
        if command.deadline is not None and not 0 < command.deadline < np.inf:
            raise ValueError(f"deadline: must be a positive number, got {command.deadline}")
        if command.trajectories is not None and command.trajectories < 1:
            raise ValueError(f"trajectories: must be at least 1, got {command.trajectories}")
    if reason is not None:
        notes.print(f"method: {method}, not adapt: {reason}")
    try:
        answer, outcomes = solve(
            query,
            starts,
            method,
            seconds=command.deadline,
            count=command.trajectories,
            with_exact=not command.no_exact,
            cluster=command.cluster,
        )
    except SolveError as error:
        notes.print(f"zermelo: {method}: {error}")
        return UNSOLVED
    document = {
        "query": query_to_dict(query),
        "method": method,
        "reaction_time_s": answer.reaction_time,
        "trajectories": answer.trajectories,
        "starts": [outcome.report() for outcome in outcomes],
    }
    for outcome in outcomes:
        if outcome.why_not:
            notes.print(f"no exact optimum from {outcome.rollout.start}: {outcome.why_not}")
    if command.json:
        print(json.dumps(document))
    else:
        Console().print(table(answer, method, outcomes))
    if command.out is not None:
        write_outputs(command.out, document, answer, outcomes)
    return 0 if any(outcome.rollout.reached for outcome in outcomes) else UNSOLVED


def table(answer: Plan, method: str, outcomes: list[Outcome]) -> Table:
    """The outcomes as a table for the terminal."""
    result = Table(title=f"{method}: policy ready in {answer.reaction_time * 1e3:.1f} ms")
    names = ", ".join(c.name for c in answer.query.system.coordinates)
    if answer.query.system.n <= MOST_NAMED:
        result.add_column(f"start ({names})")
    else:
        result.add_column("start")
        result.caption = f"start: {names}"
    for column in ("value", "cost", "exact cost", "excess", "clearance"):
        result.add_column(column, justify="right")
    result.add_column("reached")
    for o in outcomes:
        report = o.report()
        result.add_row(
            ", ".join(f"{x:.3g}" for x in o.rollout.start),
            number(report["value"]),
            number(report["cost"]),
            number(report["exact_cost"]),
            number(report["excess"], "{:.3%}"),
            number(report["min_clearance"], "{:.3f} m"),
            "yes" if o.rollout.reached else "no",
        )
    return result


def number(value: float | None, form: str = "{:.4f}") -> str:
    """A number for a table, or a dash where there is none."""
    return "-" if value is None else form.format(value)


def write_outputs(
    folder: Path, document: dict[str, Any], answer: Plan, outcomes: list[Outcome]
) -> None:
    """plan.json, trajectories.npz and pictures into `folder`.

    plan.png for a robot in the plane; motions.png, states and inputs over time, on the way to an
    equilibrium.
    """
    write_text(folder / "plan.json", json.dumps(document, indent=1) + "\n")
    arrays: dict[str, NDArray] = {}
    for k, outcome in enumerate(outcomes):
        for label, motion in (
            ("closed_loop", outcome.rollout.trajectory),
            ("exact", outcome.exact),
        ):
            if motion is not None:
                arrays[f"{label}_{k}_times"] = motion.times
                arrays[f"{label}_{k}_states"] = motion.states
                arrays[f"{label}_{k}_inputs"] = motion.inputs
                arrays[f"{label}_{k}_cost_so_far"] = motion.cost_so_far
    with atomic_path(folder / "trajectories.npz") as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    query, loops, optima = answer.query, [o.rollout for o in outcomes], [o.exact for o in outcomes]
    if query.is_regulation:
        from sims.pictures.motion_figure import motion_figure
        from sims.pictures.plan_figure import save

        save(motion_figure(query, loops, optima), folder / "motions.png")
    if moves_in_the_plane(query):
        import matplotlib.pyplot as plt

        from sims.pictures.plan_figure import draw_plan, legend, save

        figure, axes = plt.subplots(figsize=(6.4, 6.0), layout="constrained")
        draw_plan(axes, query, loops, optima, answer.value if mappable(answer) else None)
        legend(figure)
        save(figure, folder / "plan.png")


def moves_in_the_plane(query: Query) -> bool:
    """Whether the robot's position is a point of a plane, in metres."""
    system = query.system
    return len(system.position) == 2 and all(
        system.coordinates[i].unit == "m" for i in system.position
    )


def mappable(answer: Plan) -> bool:
    """Whether V at all states of a grid is a matter of moments, not of an optimisation for each."""
    return answer.query.system.n <= MOST_MAPPED and not isinstance(answer.value, ExactValue)
