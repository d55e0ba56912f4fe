"""The loop closed: a policy drives its robot until the first hit of the goal ball.

`rollouts` drives many starts at once through the compiled kernels; `drake_rollout` drives one in
Drake's error-controlled Simulator. They are tested against each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import int64, types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.kernels import kernels, parameters
from ocp.query import Query
from ocp.trajectory import Status, Trajectory
from ocp.value import Policy
from sims.disturbance import Disturbance, DisturbedLoops

GOAL_TOLERANCE = 1e-3
"""Metres: the goal ball counts as hit within this distance of it."""


@dataclass(frozen=True)
class Rollout:
    """One closed loop.

    Attributes:
        query: what the policy was made for.
        trajectory: up to the first hit of the goal, or to the time limit.
        reached: whether the goal was hit within the time limit.
        min_clearance: least distance to an obstacle along the way, metres; infinite without any.
    """

    query: Query
    trajectory: Trajectory
    reached: bool
    min_clearance: float

    @property
    def start(self) -> NDArray[np.float64]:
        return self.trajectory.start

    @property
    def cost(self) -> float | None:
        """Running cost up to the first hit; `None` if the goal was not reached.

        Where the goal is an equilibrium, the linear regulator's cost from there on is added.
        """
        if not self.reached:
            return None
        after = 0.0
        if self.query.is_regulation:
            from ocp.regulation import RegulatorValue

            after = float(RegulatorValue(self.query).value(self.trajectory.states[-1]))
        return self.trajectory.cost + after

    @property
    def collided(self) -> bool:
        """Whether the robot's ball entered an obstacle, soft ones included."""
        return self.min_clearance < 0

    def plot(self, optimum: Trajectory | None = None) -> Any:
        """A matplotlib figure of this loop, the optimum dashed beside it if given."""
        import matplotlib.pyplot as plt

        from sims.pictures.plan_figure import draw_plan, legend

        figure, axes = plt.subplots(figsize=(6.4, 6.0), layout="constrained")
        draw_plan(axes, self.query, [self], [optimum])
        legend(figure)
        return figure


@dataclass(frozen=True)
class LoopSettings:
    """How the loop is closed.

    Attributes:
        period: seconds between samples of the policy; its input is held in between.
        time_limit: seconds after which a loop counts as not having reached the goal.
        substeps: Runge-Kutta steps a period.
    """

    period: float = 0.02
    time_limit: float = 60.0
    substeps: int = 4

    def __post_init__(self) -> None:
        if not (0 < self.period <= self.time_limit < np.inf):
            raise ValueError(
                f"period: must be positive and at most time_limit, got {self.period}, "
                f"{self.time_limit}"
            )
        if self.substeps < 1:
            raise ValueError(f"substeps: must be at least 1, got {self.substeps}")


def rollout(policy: Policy, start: ArrayLike, settings: LoopSettings | None = None) -> Rollout:
    """The closed loop of `policy` from the state `start` `[n]`.

    Example:
        >>> from ocp.eikonal import solve_eikonal
        >>> from ocp.query_family import PAPER_START, paper_query
        >>> loop = rollout(solve_eikonal(paper_query((4.0, 4.0))).policy(), PAPER_START)
        >>> loop.reached, loop.collided, bool(abs(loop.cost / 23.2998 - 1) < 0.002)
        (True, False, True)
    """
    return rollouts(policy, [np.asarray(start, dtype=float)], settings)[0]


def rollouts(
    policy: Policy,
    starts: Sequence[ArrayLike],
    settings: LoopSettings | None = None,
    disturbance: Disturbance | None = None,
    seed: int = 0,
) -> list[Rollout]:
    """Closed loops from many starts `[n]`, all advanced together by compiled Runge-Kutta steps.

    Args:
        policy: the policy.
        starts: states in the policy's domain.
        settings: how the loop is closed.
        disturbance: what is wrong with the robot and its sensors; by default nothing.
        seed: of the disturbance's random numbers.

    Raises:
        ValueError: if a start or the disturbance does not fit the policy's query.
    """
    settings = settings or LoopSettings()
    query = policy.query
    system, compiled_kernels, parameter = query.system, kernels(query), parameters(query)
    states = np.array([query.check_start(s) for s in starts]).reshape(-1, system.n)
    count, substeps = len(states), settings.substeps
    steps = round(settings.time_limit / settings.period)
    step = settings.period / substeps
    position, goal = _goal_region(query)
    rows = np.zeros((count, system.n + 1))
    rows[:, :-1] = states
    active = np.flatnonzero(query.goal_distance(states) > GOAL_TOLERANCE)
    pieces: list[list[tuple[NDArray, NDArray, NDArray]]] = [[] for _ in range(count)]
    world = None
    if disturbance is not None:
        world = DisturbedLoops(disturbance, query, count, settings.period, seed)
    for k in range(steps):
        if not len(active):
            break
        here = rows[active, :-1]
        found = policy(here) if world is None else world.inputs(k, policy, active, here)
        inputs = np.require(found, dtype=float, requirements=["C", "W"])
        if not np.isfinite(inputs).all():
            raise FloatingPointError(f"the policy returned a non-finite input at step {k}")
        path = np.empty((len(active), substeps + 1, system.n + 1))
        path[:, 0] = rows[active]
        elapsed = np.empty((len(active), substeps + 1))
        length = np.empty(len(active), dtype=np.int64)
        _advance(
            compiled_kernels.dynamics,
            compiled_kernels.running_cost,
            parameter,
            inputs,
            goal,
            position,
            step,
            path,
            elapsed,
            length,
        )
        for i, index in enumerate(active):
            last = length[i]
            times = k * settings.period + elapsed[i, : last + 1]
            pieces[index].append((times, path[i, : last + 1], inputs[i]))
            rows[index] = path[i, last]
        active = active[query.goal_distance(rows[active, :-1]) > GOAL_TOLERANCE * (1 + 1e-9)]
        if world is not None:
            rows[active, :-1] = world.push(k, active, rows[active, :-1])
    return [_assemble(query, start, piece) for start, piece in zip(states, pieces, strict=True)]


def _goal_region(query: Query) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The coordinates `[d]` in which the goal's region lies; its centre, radius and periods."""
    system = query.system
    where = np.array(range(system.n) if query.is_regulation else system.position)
    radius = query.goal.radius + GOAL_TOLERANCE
    return where, np.concatenate([query.reference[where], [radius], system.period[where]])


def _assemble(query: Query, start: NDArray, pieces: list) -> Rollout:
    """One rollout from the substeps of its periods."""
    m = query.system.m
    times, states, inputs, costs = [np.zeros(1)], [start[None]], [], [np.zeros(1)]
    for piece_times, piece_path, piece_input in pieces:
        times.append(piece_times[1:])
        states.append(piece_path[1:, :-1])
        costs.append(piece_path[1:, -1])
        inputs.append(np.broadcast_to(piece_input, (len(piece_times) - 1, m)))
    inputs.append(inputs[-1][-1:] if inputs else np.zeros((1, m)))
    trajectory = Trajectory(
        np.concatenate(times),
        np.concatenate(states),
        np.concatenate(inputs),
        None,
        np.concatenate(costs),
    )
    return _judged(query, trajectory)


def _judged(query: Query, trajectory: Trajectory) -> Rollout:
    end = float(query.goal_distance(trajectory.states[-1]))
    reached = end <= GOAL_TOLERANCE * (1 + 1e-9)
    clearance = float(query.clearance(trajectory.states).min())
    status = Status.SOLVED if reached else Status.DID_NOT_REACH
    return Rollout(query, replace(trajectory, status=status), reached, clearance)


@compiled(
    types.void(
        KERNEL,
        SCALAR,
        VECTOR,
        MATRIX,
        VECTOR,
        int64[::1],
        float64,
        float64[:, :, ::1],
        MATRIX,
        int64[::1],
    )
)
def _advance(dynamics, cost, parameter, inputs, goal, position, step, path, elapsed, length):
    """Advance each row of `path` by one period under its held input, to the goal's first hit.

    A Runge-Kutta step that ends inside the goal's region is repeated, its length bisected until it
    ends on the boundary.
    """
    width = path.shape[2]
    n, m = width - 1, inputs.shape[1]
    rates = np.empty((4, width))
    trial = np.empty(width)
    xu = np.empty(n + m)
    for row in range(path.shape[0]):
        xu[n:] = inputs[row]
        elapsed[row, 0] = 0.0
        length[row] = path.shape[1] - 1
        for k in range(path.shape[1] - 1):
            low, high, h = 0.0, step, step
            hit = False
            for _ in range(60):
                for stage in range(4):
                    fraction = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                    for i in range(n):
                        xu[i] = path[row, k, i]
                        if stage > 0:
                            xu[i] += fraction * rates[stage - 1, i]
                    dynamics(xu[:n], xu[n:], rates[stage, :n])
                    rates[stage, n] = cost(xu, parameter)
                for i in range(width):
                    slope = rates[0, i] + 2.0 * (rates[1, i] + rates[2, i]) + rates[3, i]
                    trial[i] = path[row, k, i] + h / 6.0 * slope
                distance, d = 0.0, position.shape[0]
                for i in range(d):
                    gap, period = trial[position[i]] - goal[i], goal[d + 1 + i]
                    if period > 0.0:
                        gap -= period * np.round(gap / period)
                    distance += gap**2
                inside = distance <= goal[d] ** 2
                if inside:
                    hit = True
                    high = h
                else:
                    low = h
                if not hit or (inside and high - low <= 1e-12 * step):
                    break
                h = 0.5 * (low + high)
            path[row, k + 1] = trial
            elapsed[row, k + 1] = elapsed[row, k] + h
            if hit:
                length[row] = k + 1
                break


def drake_rollout(
    policy: Policy,
    start: ArrayLike,
    settings: LoopSettings | None = None,
    accuracy: float = 1e-8,
) -> Rollout:
    """The closed loop from `start` `[n]` in a Drake Diagram, its error controlled to `accuracy`.

    The goal's first hit is located on the cubic through the last two steps of the integrator.

    Raises:
        ValueError: if the start does not fit the policy's query.
    """
    from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
    from pydrake.systems.framework import DiagramBuilder, EventStatus

    from ocp.models.drake_adaptors import Plant, SampledPolicy

    settings = settings or LoopSettings()
    query = policy.query
    n = query.system.n
    initial = query.check_start(start)
    builder = DiagramBuilder()
    plant = builder.AddSystem(Plant(query))
    controller = builder.AddSystem(SampledPolicy(policy, settings.period))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("state"))
    builder.Connect(controller.GetOutputPort("u"), plant.GetInputPort("u"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    ResetIntegratorFromFlags(simulator, "runge_kutta3", settings.period / settings.substeps)
    simulator.get_mutable_integrator().set_target_accuracy(accuracy)
    context = simulator.get_mutable_context()
    plant_context = diagram.GetMutableSubsystemContext(plant, context)
    controller_context = diagram.GetMutableSubsystemContext(controller, context)
    plant_context.SetContinuousState([*initial, 0.0])  # pyright: ignore[reportArgumentType]

    record: list[tuple[float, NDArray, NDArray]] = []

    def monitor(root: Any) -> EventStatus:
        row: Any = plant_context.get_continuous_state_vector().CopyToVector()
        held: Any = controller_context.get_discrete_state_vector().CopyToVector()
        if record and record[-1][0] == root.get_time():
            record.pop()
        record.append((root.get_time(), row, held))
        if query.goal_distance(row[:n]) <= GOAL_TOLERANCE:
            return EventStatus.ReachedTermination(diagram, "goal")
        return EventStatus.DidNothing()

    simulator.set_monitor(monitor)
    simulator.Initialize()
    simulator.AdvanceTo(settings.time_limit)
    times = np.array([t for t, _, _ in record])
    rows = np.array([row for _, row, _ in record])
    inputs = np.array([u for _, _, u in record])
    if len(record) > 1 and query.goal_distance(rows[-1, :n]) <= GOAL_TOLERANCE:
        times[-1], rows[-1] = _first_hit(query, times[-2:], rows[-2:], inputs[-1])
    trajectory = Trajectory(times, rows[:, :n], inputs, None, rows[:, n])
    return _judged(query, trajectory)


def _first_hit(query: Query, times: NDArray, rows: NDArray, u: NDArray) -> tuple[float, NDArray]:
    """Time and row (state and cost) at which the cubic between two rows enters the goal ball."""
    from scipy.interpolate import CubicHermiteSpline
    from scipy.optimize import brentq

    from ocp.compiled.batch import rates, running_costs

    held = np.broadcast_to(u, (2, len(u)))
    slopes = np.column_stack(
        [rates(query, rows[:, :-1], held), running_costs(query, rows[:, :-1], held)]
    )
    cubic = CubicHermiteSpline(times, rows, slopes)

    def distance(t: float) -> float:
        return float(query.goal_distance(cubic(t)[:-1])) - GOAL_TOLERANCE

    if distance(times[0]) <= 0:
        return float(times[0]), rows[0]
    hit: Any = brentq(distance, times[0], times[1], xtol=1e-13)
    return float(hit), cubic(hit)
