"""Figures of motions to an equilibrium: every state and input over time, whatever the robot."""

from collections.abc import Sequence
from itertools import chain

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ocp.query import Query
from ocp.trajectory import Trajectory
from sims.closed_loop import Rollout
from sims.pictures.plan_figure import CLOSED_LOOP, GOAL, OPTIMUM

COLUMNS = 3


def motion_figure(
    query: Query, rollouts: Sequence[Rollout], optima: Sequence[Trajectory | None] = ()
) -> Figure:
    """A panel for each state, with the equilibrium's, and for each input, with its limits."""
    system = query.system
    panels = system.n + system.m
    rows = -(-panels // COLUMNS)
    figure, axes = plt.subplots(
        rows, COLUMNS, figsize=(9.6, 1.9 * rows + 0.7), sharex=True, layout="constrained"
    )
    flat = axes.flatten()
    for i, (axis, coordinate) in enumerate(zip(flat, system.coordinates, strict=False)):
        for wanted in _reached_copies(query, i, [r.trajectory for r in rollouts]):
            axis.axhline(wanted, color=GOAL, lw=1.0)
        axis.set_ylabel(f"{coordinate.name} ({coordinate.unit})")
    for axis, actuator in zip(flat[system.n :], system.inputs, strict=False):
        for limit in (actuator.lower, actuator.upper):
            if np.isfinite(limit):
                axis.axhline(limit, color="0.6", lw=0.8, ls=":")
        axis.set_ylabel(f"{actuator.name} ({actuator.unit})")
    for rollout in rollouts:
        _curves(flat, rollout.trajectory, color=CLOSED_LOOP, lw=1.4)
    for optimum in optima:
        if optimum is not None:
            _curves(flat, optimum, color=OPTIMUM, lw=1.6, ls=(0, (5, 3)))
    for axis in flat[panels:]:
        axis.axis("off")
    for axis in flat[max(0, panels - COLUMNS) : panels]:
        axis.set_xlabel("time (s)")
        axis.tick_params(labelbottom=True)
    for axis in flat[:panels]:
        axis.grid(alpha=0.3)
    handles = [Line2D([], [], color=CLOSED_LOOP, label="closed loop")]
    if any(optimum is not None for optimum in optima):
        handles.append(Line2D([], [], color=OPTIMUM, ls="--", label="exact optimum"))
    handles.append(Line2D([], [], color=GOAL, label="equilibrium"))
    if any(np.isfinite([i.lower, i.upper]).any() for i in system.inputs):
        handles.append(Line2D([], [], color="0.6", ls=":", label="limit of an input"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _reached_copies(query: Query, i: int, motions: Sequence[Trajectory]) -> set[float]:
    """The i-th coordinate's goal; if it is periodic, those of its copies that motions come to."""
    coordinate, wanted = query.system.coordinates[i], float(query.reference[i])
    if not coordinate.periodic:
        return {wanted}
    turns = {round((motion.states[-1, i] - wanted) / coordinate.extent) for motion in motions}
    return {wanted + turn * coordinate.extent for turn in turns}


def _curves(axes: Sequence[Axes], motion: Trajectory, **style: object) -> None:
    """States, then inputs, over time; a periodic coordinate is drawn as it was driven through."""
    for axis, column in zip(axes, chain(motion.states.T, motion.inputs.T), strict=False):
        axis.plot(motion.times, column, **style)  # pyright: ignore[reportArgumentType]
