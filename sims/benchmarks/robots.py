"""`zermelo bench robots`: robots from files, against Drake.

Evaluation: x' compiled, one call for all states, and one call a state, against Drake's
CalcTimeDerivatives from Python. Transcription: one solve of ours (Radau, exact second derivatives)
against one of Drake's DirectCollocation (Hermite-Simpson), from the same rough guess, with
as many points and the same IPOPT; the guess, building and compiling are not counted. Drake gives no
second derivatives: with SNOPT, which the referee's costs come from, it solves what IPOPT does not.
With our checked optimum three of Drake's costs are compared, whose rule for the cost is of second
order: those at the same and at twice the points, and the extrapolated one (Richardson). acados, a
further peer, is not on the package index; rockit (rockit-meco) is, and is not compared yet.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from ocp.compiled.batch import rates
from ocp.kernels import kernels
from ocp.query import Query
from ocp.regulation import regulator, solve_regulation
from ocp.trajectory import SolveError, Trajectory
from ocp.transcription.programme import Problem, program
from ocp.transcription.terms import Structure
from sims.benchmarks import Report

Array = NDArray[np.float64]

STATES = 20_000
DRAKE_STATES = 1_000
INTERVALS, DEGREE = 20, 3
KNOTS = INTERVALS * DEGREE + 1
DRAKE_TOLERANCE = 1e-6  # of IPOPT; ours solves to 1e-9
REFEREE_TOLERANCE = 1e-5  # of SNOPT, on costs in units of the guess's
DRAKE_SECONDS = 60.0  # processor time for each of Drake's solves; then it counts as failed
DRAKE_ITERATIONS = 1000
FLIGHTS: dict[str, tuple[float, ...]] = {
    "pendulum": (0.0, 0.0),
    "cart-pole": (0.0, 0.0, 0.0, 0.0),
    "acrobot": (0.0, 0.0, 0.0, 0.0),
    "quadrotor": (-3.0, -0.5, 0.0, 0.0, 0.0, 0.0),
}
"""The shipped query files, and where their motions start."""
HORIZON = {"pendulum": 3.0, "cart-pole": 4.0, "acrobot": 4.0, "quadrotor": 5.0}
ROUGHNESS = {"acrobot": 0.1}
"""Of the guess: its share of a straight line, else one half; from there no solver of Drake's finds
the acrobot's swing-up."""


def run(seed: int, _out: Path | None) -> Report:
    """Measure; returns figures and tables."""
    report = Report()
    evaluation, transcription = _evaluation(seed), {}
    for name in FLIGHTS:
        transcription[name] = _against_drake(name)
    report.figures = {"evaluation": evaluation, "transcription": transcription}
    report.tables = [_evaluation_table(evaluation), _transcription_table(transcription)]
    return report


def _seconds(task: Callable[[], Any], repeats: int = 5) -> float:
    """Least processor time of this thread: other work on the machine does not count."""
    best = np.inf
    for _ in range(repeats):
        begun = time.thread_time()
        task()
        best = min(best, time.thread_time() - begun)
    return float(best)


def _evaluation(seed: int) -> dict[str, Any]:
    from ocp.models.multibody import multibody_model
    from ocp.models.robots import ROBOTS, robot_file

    figures = {}
    for name in ROBOTS:
        model = multibody_model(robot_file(name))
        system = model.system
        query = _any_query(name)
        rng = np.random.default_rng(seed)
        states = rng.uniform(system.lower, system.upper, (STATES, system.n))
        low, high = (np.clip(b, -10.0, 10.0) for b in query.input_bounds)
        inputs = rng.uniform(low, high, (STATES, system.m))
        diagram = model.diagram()
        context = diagram.CreateDefaultContext()
        port = diagram.GetInputPort("u")
        drake_states = model.to_drake(states[:DRAKE_STATES])

        def drake(rows=drake_states, given=inputs, diagram=diagram, context=context, port=port):
            out = np.empty_like(rows)
            for i, x in enumerate(rows):
                context.SetContinuousState(x)
                port.FixValue(context, given[i])
                out[i] = diagram.EvalTimeDerivatives(context).CopyToVector()
            return out

        single = kernels(query).dynamics
        rate = np.empty(system.n)

        def one_by_one(single=single, states=states, inputs=inputs, rate=rate):
            for i in range(DRAKE_STATES):
                single(states[i], inputs[i], rate)

        expected = model.from_drake(drake())
        error = np.abs(rates(query, states[:DRAKE_STATES], inputs[:DRAKE_STATES]) - expected)
        seconds = {
            "drake": _seconds(drake, 3) / DRAKE_STATES,
            "single": _seconds(one_by_one, 3) / DRAKE_STATES,
            "batch": _seconds(lambda q=query, s=states, u=inputs: rates(q, s, u)) / STATES,
        }
        figures[name] = {
            "states": system.n,
            "operations": system.dynamics.n_instructions(),
            "largest_error": float((error.max(axis=1) / np.abs(expected).max(axis=1)).max()),
            **{f"{way}_us": 1e6 * s for way, s in seconds.items()},
            "batch_ratio": seconds["drake"] / seconds["batch"],
            "single_ratio": seconds["drake"] / seconds["single"],
        }
    return figures


def _any_query(model: str) -> Query:
    """A query of the robot: its kernels are wanted, not its motions."""
    from ocp.cost import RunningCost
    from ocp.models import get_model
    from ocp.query import Equilibrium

    system = get_model(model)
    rest = np.zeros(system.n)
    weights = tuple(tuple(map(float, row)) for row in np.eye(system.n))
    return Query(model, Equilibrium(tuple(rest), 0.1), cost=RunningCost(goal=0.0, state=weights))


def _against_drake(name: str) -> dict[str, Any]:
    from ocp.models.drake_collocation import Solver, drake_collocation
    from ocp.models.multibody import multibody_model
    from ocp.models.robots import robot_file

    query = Query.load(Path(__file__).parent.parent / "queries" / f"{name}.toml")
    assert isinstance(query.model, str)
    start, P = np.array(FLIGHTS[name]), regulator(query).matrix
    optimum = solve_regulation(query, start)
    rough = _perturbed(query, _head(optimum, HORIZON[name]), ROUGHNESS.get(name, 0.5))
    span = (rough.duration, rough.duration)
    mesh = np.linspace(0.0, 1.0, INTERVALS + 1)
    margin = 1e-4 if query.hard_obstacles else 0.0
    problem = Problem(query, start, mesh, span, P, margin)
    structure = Structure.of(query, INTERVALS, DEGREE, ends_at_goal=False)
    begun = time.thread_time()
    ready = program(structure)
    figures: dict[str, Any] = {"optimum": optimum.cost, "build_s": time.thread_time() - begun}
    ours = ready.solve(problem, rough, 0.0, np.inf)
    figures["ours_cost"] = ours.total_cost
    figures["cold_s"] = _seconds(lambda: ready.solve(problem, rough, 0.0, np.inf), 3)
    try:
        figures["warm_s"] = _seconds(lambda: ready.solve(problem, ours, 0.0, np.inf), 3)
    except SolveError:  # the multipliers of chattering inputs mislead a warm start
        figures["warm_s"] = None
    model = multibody_model(robot_file(query.model))
    for solver, knots, tolerance in (
        (Solver.IPOPT, KNOTS, DRAKE_TOLERANCE),
        (Solver.SNOPT, KNOTS, REFEREE_TOLERANCE),
        (Solver.SNOPT, 2 * KNOTS - 1, REFEREE_TOLERANCE),
    ):
        begun, label = time.thread_time(), f"{solver.value}_{knots}"
        try:
            found = drake_collocation(
                model, query, rough, P, knots=knots, tolerance=tolerance, solver=solver,
                max_iterations=DRAKE_ITERATIONS, time_limit=DRAKE_SECONDS,
            )  # fmt: skip
        except SolveError as error:
            figures |= {label: None, f"{label}_s": None, f"{label}_failed": str(error)}
            continue
        figures |= {label: found.cost, f"{label}_s": time.thread_time() - begun}
        figures[f"{label}_difference"] = found.cost / optimum.cost - 1
    coarse, fine = (figures[f"snopt_{k}"] for k in (KNOTS, 2 * KNOTS - 1))
    if coarse is not None and fine is not None:
        extrapolated = (4 * fine - coarse) / 3  # half the step, a quarter of the error
        figures["extrapolated_difference"] = extrapolated / optimum.cost - 1
    for way in ("ipopt", "snopt"):
        seconds = figures[f"{way}_{KNOTS}_s"]
        figures[f"{way}_ratio"] = None if seconds is None else seconds / figures["cold_s"]
    return figures


def _head(motion: Trajectory, seconds: float) -> Trajectory:
    keep = motion.times <= seconds
    return replace(
        motion,
        times=motion.times[keep],
        states=motion.states[keep],
        inputs=motion.inputs[keep],
        costates=None,
        cost_so_far=motion.cost_so_far[keep],
    )


def _perturbed(query: Query, motion: Trajectory, line: float) -> Trajectory:
    """The optimum moved towards a straight line: a guess from which all solvers find it again."""
    share = (motion.times / motion.duration)[:, None]
    straight = (1 - share) * motion.states[0] + share * motion.states[-1]
    inputs = (1 - line) * motion.inputs + line * query.reference_input
    return replace(motion, states=(1 - line) * motion.states + line * straight, inputs=inputs)


def _evaluation_table(figures: dict[str, Any]) -> Table:
    table = Table(title="x' at one state, microseconds of one core")
    for column in ("robot", "states", "Drake", "ours, single", "ours, batch", "ratio", "error"):
        table.add_column(column, justify="left" if column == "robot" else "right")
    for name, f in figures.items():
        table.add_row(
            name, str(f["states"]), f"{f['drake_us']:.1f}", f"{f['single_us']:.2f}",
            f"{f['batch_us']:.3f}", f"{f['batch_ratio']:.0f}", f"{f['largest_error']:.1e}",
        )  # fmt: skip
    return table


def _transcription_table(figures: dict[str, Any]) -> Table:
    table = Table(title=f"one solve, {KNOTS} points: seconds of one core")
    fine = f"snopt_{2 * KNOTS - 1}"
    columns = (
        "query", "optimum", "Drake's gap", "finer", "extrapolated", "cold", "warm", "Drake, IPOPT",
        "ratio", "Drake, SNOPT", "ratio", "finer",
    )  # fmt: skip
    for column in columns:
        table.add_column(column, justify="left" if column == "query" else "right")

    def told(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    for name, f in figures.items():
        coarse = f"snopt_{KNOTS}"
        gaps = (f"{coarse}_difference", f"{fine}_difference", "extrapolated_difference")
        table.add_row(
            name, f"{f['optimum']:.4f}", *(told(f.get(gap), "+.4%") for gap in gaps),
            told(f["cold_s"], ".3f"), told(f["warm_s"], ".3f"),
            told(f[f"ipopt_{KNOTS}_s"], ".2f"), told(f["ipopt_ratio"], ".0f"),
            told(f[f"{coarse}_s"], ".2f"), told(f["snopt_ratio"], ".0f"),
            told(f[f"{fine}_s"], ".2f"),
        )  # fmt: skip
    return table
