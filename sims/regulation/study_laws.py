"""The study's legs: the paper's law, its slips one at a time, and the law that converges."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.certificate import relative_gain_error
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.paper_law import LITERAL, REPAIRED, PaperLaw, PaperSettings, Slip
from sims.regulation.simulation import drive_legs
from sims.regulation.study_motions import GRID, SEEDS, load, plant_of
from sims.regulation.system_file import SystemFile

Array = NDArray[np.float64]

WAYPOINTS = np.array([[5.0 * k * np.sqrt(0.5), 5.0 * k * np.sqrt(0.5), 0.0, 0.0] for k in range(7)])
"""Six legs of 5 m, for the plants with two positions and two velocities."""


def drive_law(
    slips: frozenset[Slip], system: SystemFile, seed: int, probing: float, period: float = 0.005
) -> tuple[PaperLaw, int, bool, list[float], list[float]]:
    """A paper law along the legs: itself, legs reached, whether finite, gain error over time."""
    times = np.linspace(0.0, system.cost.horizon, GRID)
    exact = system.exact().gain(times)
    settings = PaperSettings(sample_period=period, probing=probing)
    law = PaperLaw(system.cost, settings, np.random.default_rng(seed), slips)
    moments: list[float] = []
    errors: list[float] = []

    def watch(now: float) -> None:
        if not moments or now - moments[-1] >= 0.1 - 1e-9:
            moments.append(now)
            errors.append(np.inf if law.diverged else relative_gain_error(law.gain(times), exact))

    course = drive_legs(plant_of(system), law, WAYPOINTS, period, system.cost.horizon, watch=watch)
    finite = not law.diverged and not course.blew_up
    return law, course.reached, finite, moments, errors


def laws(out: Path | None = None) -> None:
    print("the paper's law along six legs of 5 m, 20 seeds")
    curves: dict[str, list[tuple[list[float], list[float]]]] = {}
    for name in ("rover", "springless-rover", "double-integrator-2d"):
        system = load(name)
        for slips in (LITERAL, REPAIRED):
            for probing in (0.0, system.probing):
                runs = [drive_law(slips, system, seed, probing) for seed in SEEDS]
                finite = [run[2] for run in runs]
                reached = [run[1] for run in runs]
                last = np.array([run[4][-1] for run in runs])
                settled = last[finite]
                spread = (
                    f"gain error {settled.min():.2g} to {settled.max():.2g}"
                    if len(settled)
                    else "no gain left"
                )
                beta = max(run[0].excitation() for run in runs)
                bad = sum(not run[0].gain_bound().is_admissible for run in runs)
                print(
                    f"{name:21s} {runs[0][0].name:14s} probing {probing:5g}: diverged "
                    f"{len(runs) - sum(finite)} of {len(runs)}; {spread}; legs reached "
                    f"{min(reached)} to {max(reached)}; largest beta {beta:.1e}; alpha_a "
                    f"inadmissible at the end in {bad}"
                )
                if name == "rover" and probing == 0:
                    curves[runs[0][0].name] = [(run[3], run[4]) for run in runs]
    system = load("rover")
    curves["q-learning"] = [drive_learner(system, seed) for seed in SEEDS]
    last = [errors[-1] for _, errors in curves["q-learning"]]
    print(f"rover                 q-learning     probing   100: gain error at most {max(last):.1e}")
    if out is not None:
        draw_laws(curves, out / "q-learning-laws.png")


def slips() -> None:
    """Each slip alone: the repaired law on plant (26) with that slip left in, no probing."""
    system = load("rover")
    print("the repaired law with one slip left in, six legs of 5 m on plant (26), 20 seeds")
    for kept in (REPAIRED, *(frozenset({slip}) for slip in Slip), LITERAL):
        runs = [drive_law(kept, system, seed, 0.0) for seed in SEEDS]
        lost = sum(not run[2] for run in runs)
        last = np.array([run[4][-1] for run in runs if run[2]])
        spread = f"gain error {last.min():.3g} to {last.max():.3g}" if len(last) else "no gain left"
        print(f"{runs[0][0].name:44s}: diverged {lost:2d} of {len(runs)}; {spread}")


def drive_learner(system: SystemFile, seed: int) -> tuple[list[float], list[float]]:
    """The converging law along the same legs; probes until its certificate holds."""
    times = np.linspace(0.0, system.cost.horizon, GRID)
    exact = system.exact().gain(times)
    settings = LearnerSettings(probing=system.probing)
    learner = QLearner(system.cost, settings, np.random.default_rng(seed))
    moments: list[float] = []
    errors: list[float] = []

    def watch(now: float) -> None:
        if not moments or now - moments[-1] >= 0.1 - 1e-9:
            known = learner.regulator
            moments.append(now)
            errors.append(1.0 if known is None else relative_gain_error(known.gain(times), exact))

    drive_legs(plant_of(system), learner, WAYPOINTS, 0.01, system.cost.horizon, watch=watch)
    return moments, errors


def draw_laws(curves: dict[str, list[tuple[list[float], list[float]]]], path: Path) -> None:
    """Gain error over time of every seed, a panel for each law."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        1, 3, figsize=(13, 4), sharex=True, sharey=True, layout="constrained"
    )
    for panel, (name, runs) in zip(axes, curves.items(), strict=True):
        for moments, errors in runs:
            shown = np.array(errors)
            panel.plot(moments, np.where(shown < 1e12, shown, np.nan), color="#0072B2", alpha=0.5)
            if not np.isfinite(shown[-1]):
                last = int(np.flatnonzero(shown < 1e12)[-1])
                panel.plot(moments[last], shown[last], "x", color="#D55E00")
        panel.axhline(1.0, color="0.5", linestyle=":")
        panel.set_yscale("log")
        panel.set_title(name + (" (x: diverged)" if name == "paper-literal" else ""))
        panel.set_xlabel("seconds (six legs of 5 m on plant (26))")
    axes[0].set_ylabel("gain error against Riccati (dotted: u = 0)")
    figure.savefig(path, dpi=110)
    plt.close(figure)
