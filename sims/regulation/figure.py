"""The figure of a regulation: what was learned, how well, and how it drives."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sims.regulation.regulate import GRID, Regulation, names
from sims.regulation.simulation import LinearPlant, regulated_costs

# Colours that stay apart for the colour-blind (after Okabe and Ito).
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442"]
SHOWN = 6
"""States, inputs and gain entries drawn at most, the largest first."""


def draw_regulation(result: Regulation) -> Figure:
    """Six panels: gain error, excitation, weights; gain, states and inputs against the optimum."""
    figure, axes = plt.subplots(2, 3, figsize=(15, 8), layout="constrained")
    figure.suptitle(_title(result))
    _draw_error(axes[0, 0], result)
    _draw_excitation(axes[0, 1], result)
    _draw_weights(axes[0, 2], result)
    _draw_gain(axes[1, 0], result)
    _draw_motion(axes[1, 1], axes[1, 2], result)
    return figure


def _title(result: Regulation) -> str:
    report = result.report()
    error = "none" if result.gain_error is None else f"{result.gain_error:.2g}"
    excess = "unknown" if report["excess"] is None else f"{report['excess']:.2g}"
    verdict = "converged" if result.converged else f"not converged: {result.reason}"
    return (
        f"{result.learner}, {result.system.data_seconds:g} s of data: gain error {error}, "
        f"excess cost {excess}\n{verdict}"
    )


def _draw_error(axes: Axes, result: Regulation) -> None:
    history = result.history
    axes.set_title("gain error against Riccati")
    axes.axhline(1.0, color="0.6", linestyle=":", label="u = 0")
    _positive(axes, history.times, history.gain_errors, COLOURS[0], "-", "measured")
    if np.isfinite(history.claims).any():
        _positive(axes, history.times, history.claims, COLOURS[1], "--", "claimed from the data")
    axes.set_yscale("log")
    axes.set_xlabel("seconds of data")
    axes.legend()


def _draw_excitation(axes: Axes, result: Regulation) -> None:
    history = result.history
    axes.set_xlabel("seconds of data")
    if np.isfinite(history.conditions).any():
        axes.set_title("excitation")
        _positive(axes, history.times, history.conditions, COLOURS[0], "-", "condition number")
        axes.set_yscale("log")
        axes.set_ylabel("condition number", color=COLOURS[0])
        other = axes.twinx()
        rank = np.array(history.excitations) * result.required_rank
        other.plot(history.times, rank, color=COLOURS[1], drawstyle="steps-post")
        other.axhline(result.required_rank, color=COLOURS[1], linestyle=":")
        other.set_ylim(0, 1.05 * result.required_rank)
        other.set_ylabel(f"rank (of {result.required_rank})", color=COLOURS[1])
    else:
        axes.set_title("persistence of excitation, beta of Lemma 4.2")
        _positive(axes, history.times, history.excitations, COLOURS[0], "-", "beta so far")
        if max(history.excitations) > 0:
            axes.set_yscale("log")
            axes.legend()
        else:
            axes.text(0.5, 0.5, "beta = 0: not persistent", ha="center", transform=axes.transAxes)


def _draw_weights(axes: Axes, result: Regulation) -> None:
    axes.set_title("learned parameters")
    weights = np.array(result.history.weights)
    weights = np.where(np.abs(weights) < 1e12, weights, np.nan)
    axes.plot(result.history.times, weights, linewidth=0.8)
    if np.nanmax(np.abs(weights), initial=0.0) > 1e3:
        axes.set_yscale("symlog", linthresh=1.0)
    axes.set_xlabel("seconds of data")


def _draw_gain(axes: Axes, result: Regulation) -> None:
    times = np.linspace(0.0, result.system.cost.horizon, GRID)
    exact = result.exact.gain(times).reshape(GRID, -1)
    order = np.argsort(-np.abs(exact).max(axis=0))[:SHOWN]
    n = result.system.problem.n
    learned = None if result.gain is None else result.gain(times).reshape(GRID, -1)
    for colour, index in zip(COLOURS, order, strict=False):
        label = f"K{index // n + 1},{index % n + 1}"
        axes.plot(times, exact[:, index], color="0.6", linewidth=3)
        if learned is not None:
            axes.plot(times, learned[:, index], color=colour, linewidth=1.2, label=label)
    reach = 20 * np.abs(exact).max()
    if learned is not None and np.abs(learned).max() > reach:
        axes.set_ylim(-reach, reach)
    axes.set_title("gain K(t): learned over exact (grey)")
    axes.set_xlabel("time in the horizon, s")
    if learned is not None:
        axes.legend(fontsize="small")


def _draw_motion(states: Axes, inputs: Axes, result: Regulation) -> None:
    system = result.system
    plant = LinearPlant(system.problem.A, system.problem.B)
    state_names, input_names = names(system)
    _, times, best = regulated_costs(plant, system.cost, result.exact.gain, system.start)
    runs: list[tuple[Any, Any, str | None, float, str | None]] = [
        (best[0], result.exact.gain, "0.6", 3.0, None)
    ]
    if result.gain is not None:
        _, _, own = regulated_costs(plant, system.cost, result.gain, system.start)
        if np.isfinite(own).all():
            runs.append((own[0], result.gain, None, 1.2, "learned"))
    for path, gain, grey, width, label in runs:
        u = -np.einsum("kij,kj->ki", gain(times), path)
        for axes, rows, labels in ((states, path, state_names), (inputs, u, input_names)):
            for index in range(min(rows.shape[1], SHOWN)):
                axes.plot(
                    times,
                    rows[:, index],
                    color=grey or COLOURS[index],
                    linewidth=width,
                    label=labels[index] if label else None,
                )
    _limit(states, best[0])
    _limit(inputs, -np.einsum("kij,kj->ki", result.exact.gain(times), best[0]))
    states.set_title("states of a fresh run over the optimum (grey)")
    inputs.set_title("inputs of a fresh run over the optimum (grey)")
    for axes in (states, inputs):
        axes.set_xlabel("time, s")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="small")


def _positive(
    axes: Axes, times: list[float], values: list[float], colour: str, line: str, label: str
) -> None:
    """Plot what is finite and positive."""
    numbers = np.array(values)
    numbers = np.where(np.isfinite(numbers) & (numbers > 0), numbers, np.nan)
    axes.plot(times, numbers, line, color=colour, label=label)


def _limit(axes: Axes, values: np.ndarray) -> None:
    """Keep the optimum readable beside a law that went astray."""
    low, high = float(values.min()), float(values.max())
    margin = 0.5 * (high - low) + 1e-9
    axes.set_ylim(low - margin, high + margin)
