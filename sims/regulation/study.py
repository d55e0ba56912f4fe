"""What is claimed of Q-learning, measured: prints every figure that the documents quote.

`python -m sims.regulation.study PART [--out DIR]`; PART is noise-free, noise, random, laws, slips,
events, times, benchmarks, picture or all. Pictures go to DIR.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.certificate import Certificate, relative_gain_error
from learning.q_learning.event_trigger import (
    IntermittentController,
    NormTrigger,
    QuadraticTrigger,
    Trigger,
)
from learning.q_learning.identification import identify
from learning.q_learning.learned_regulator import LearnedRegulator, solve_backward
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.paper_law import LITERAL, REPAIRED, PaperLaw, PaperSettings, Slip
from learning.q_learning.quadratic_cost import QuadraticCost
from learning.q_learning.window_regression import WindowRegression
from ocp.riccati import LinearQuadratic, algebraic_riccati
from sims.regulation.regulate import SUBSTEPS, learner_settings
from sims.regulation.simulation import (
    LinearPlant,
    drive_legs,
    probed_motions,
    regulated_costs,
    sampled_motion,
)
from sims.regulation.system_file import SystemFile, shipped_systems

Array = NDArray[np.float64]

SEEDS = range(20)
GRID = 101
NOISY = (
    ("rover", 1e-3, 10.0),
    ("springless-rover", 1e-3, 10.0),
    ("double-integrator-1d", 1e-3, 10.0),
    ("double-integrator-2d", 1e-3, 10.0),
    ("double-integrator-3d", 1e-3, 10.0),
    ("double-integrator-3d", 1e-3, 60.0),
    ("unstable", 1e-3, 10.0),
    ("cart-pole", 1e-3, 10.0),
    ("rover", 1e-2, 60.0),
    ("springless-rover", 1e-2, 60.0),
    ("double-integrator-1d", 1e-2, 60.0),
    ("double-integrator-2d", 1e-2, 60.0),
    ("double-integrator-3d", 1e-2, 60.0),
)
"""System, standard deviation of the measured state's noise, seconds of data."""


def load(name: str, **changes: Any) -> SystemFile:
    """A shipped system, with fields changed."""
    return replace(SystemFile.load(shipped_systems()[name]), **changes)


def plant_of(system: SystemFile) -> LinearPlant:
    return LinearPlant(system.problem.A, system.problem.B)


def recorded(system: SystemFile, seeds: Sequence[int]) -> tuple[Array, Array]:
    """Probed motions of a system for many seeds: see `probed_motions`."""
    return probed_motions(
        plant_of(system),
        system.start,
        system.data_seconds,
        system.sample_period,
        SUBSTEPS,
        system.probing,
        system.behaviour_gain,
        system.noise,
        seeds,
    )


def learn(system: SystemFile, states: Array, inputs: Array) -> tuple[QLearner, Certificate]:
    """A learner that was shown one recorded motion."""
    learner = QLearner(system.cost, learner_settings(system))
    learner.absorb(states, inputs)
    return learner, learner.certify()


def gain_errors(system: SystemFile, seeds: Sequence[int]) -> tuple[Array, Array]:
    """Measured and claimed gain error of each seed; infinite where nothing was learned."""
    times = np.linspace(0.0, system.cost.horizon, GRID)
    exact = system.exact().gain(times)
    measured, claimed = [], []
    for states, inputs in zip(*recorded(system, seeds), strict=True):
        learner, certificate = learn(system, states, inputs)
        claimed.append(certificate.gain_error)
        known = learner.regulator
        error = np.inf if known is None else relative_gain_error(known.gain(times), exact)
        measured.append(error)
    return np.array(measured), np.array(claimed)


def noise_free() -> None:
    print("noise-free: worst of 5 seeds; cost of K(t) interpolated, and held 50 ms, over optimum")
    header = "seconds windows rank  gain error     claim  condition  excess  excess held"
    print(f"{'system':22s} {header}")
    for name in shipped_systems():
        system = load(name, noise=0.0)
        errors, claims = gain_errors(system, range(5))
        states, inputs = recorded(system, [0])
        learner, certificate = learn(system, states[0], inputs[0])
        known = learner.learned()
        plant, exact = plant_of(system), system.exact()
        best = float(exact.value(system.start))
        excess = regulated_costs(plant, system.cost, known.gain, system.start)[0][0] / best - 1
        held = regulated_costs(plant, system.cost, known.gain, system.start, hold=0.05)[0][0]
        seen = certificate.excitation
        print(
            f"{name:22s} {system.data_seconds:7g} {seen.rows:7d} {seen.rank:4d}  "
            f"{errors.max():10.1e}  {claims.max():8.1e}  {seen.condition:9.1e}  "
            f"{excess:6.0e}  {held / best - 1:6.0e}"
        )


def noise() -> None:
    print("noise: median and worst gain error of 20 seeds, beside identify-then-Riccati")
    for name, deviation, seconds in NOISY:
        system = load(name, noise=deviation, data_seconds=seconds)
        errors, claims = gain_errors(system, SEEDS)
        identified = identification_errors(system, SEEDS)
        print(
            f"{name:22s} noise {deviation:g}, {seconds:g} s: median {np.median(errors):.4f} worst "
            f"{errors.max():.4f}; claimed {np.median(claims):.4f}, largest error/claim "
            f"{(errors / claims).max():.1f}; identified {np.median(identified):.4f} worst "
            f"{identified.max():.4f}"
        )


def identification_errors(system: SystemFile, seeds: Sequence[int]) -> Array:
    """Gain error of identify-then-Riccati from the same data and windows."""
    times = np.linspace(0.0, system.cost.horizon, GRID)
    exact = system.exact().gain(times)
    settings = learner_settings(system)
    errors = []
    for states, inputs in zip(*recorded(system, seeds), strict=True):
        known = identify(states, inputs, system.sample_period, settings.window)
        errors.append(relative_gain_error(known.riccati(system.cost).gain(times), exact))
    return np.array(errors)


def random_system(rng: np.random.Generator) -> SystemFile:
    """A random controllable plant of 1 to 5 states and 1 to 3 inputs, stable or not."""
    n = int(rng.integers(1, 6))
    m = int(rng.integers(1, 1 + min(n, 3)))
    A, B = rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(n, m))
    root = rng.normal(size=(n, n))
    M, R = root @ root.T, np.diag(rng.uniform(0.5, 2.0, m))
    unknowns = n * (n + 1) // 2 + m * n
    seconds = 2 * unknowns * SUBSTEPS * 0.01
    return SystemFile(
        LinearQuadratic(A, B, M, R),
        QuadraticCost(M, R, np.eye(n), 3.0),
        rng.normal(size=n),
        data_seconds=max(0.5, seconds),
    )


def random_systems(count: int = 200) -> None:
    """Learned from twice the windows that the rank needs."""
    learned, broken, ratios, errors = 0, 0, [], []
    for seed in range(count):
        system = random_system(np.random.default_rng(seed))
        states, inputs = recorded(system, [seed])
        learner, certificate = learn(system, states[0], inputs[0])
        if not certificate.holds or learner.regulator is None:
            continue
        times = np.linspace(0.0, system.cost.horizon, GRID)
        exact = system.exact().gain(times)
        error = relative_gain_error(learner.regulator.gain(times), exact)
        learned += 1
        broken += error > 10 * certificate.gain_error
        ratios.append(error / certificate.gain_error)
        errors.append(error)
    print(
        f"{count} random systems: {learned} declared learned, {broken} of them with an error above "
        f"ten times the claim; largest error/claim {max(ratios):.2g}, median error "
        f"{np.median(errors):.1e}, largest {max(errors):.1e}"
    )


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


def intermittent(
    system: SystemFile, regulator: LearnedRegulator, trigger: Trigger, period: float
) -> tuple[float, int, int]:
    """Cost over optimum minus 1, updates and looks of one event-triggered run to the horizon."""
    controller = IntermittentController(regulator, trigger, period)
    plant, cost = plant_of(system), system.cost
    motion = sampled_motion(plant, controller, system.start, cost.horizon, period)
    total = held_cost(plant, cost, motion.states, motion.inputs, period)
    best = float(system.exact().value(system.start))
    return total / best - 1, controller.updates, controller.looks


def held_cost(
    plant: LinearPlant, cost: QuadraticCost, states: Array, inputs: Array, period: float
) -> float:
    """The exact cost of a motion `[k + 1, n]` whose inputs were held over each `period`."""
    from scipy.linalg import expm

    n, m = plant.B.shape
    # Van Loan: the integral of exp(F't) W exp(F t) over a period, F of the pair (x, u held).
    F = np.zeros((n + m, n + m))
    F[:n] = np.column_stack([plant.A, plant.B])
    W = np.zeros_like(F)
    W[:n, :n], W[n:, n:] = cost.M, cost.R
    size = n + m
    block = expm(np.block([[-F.T, W], [np.zeros_like(F), F]]) * period)
    integral = block[size:, size:].T @ block[:size, size:]
    pairs = np.column_stack([states[:-1], inputs[:-1]])
    running = np.einsum("ki,ij,kj->", pairs, integral, pairs)
    return float(running + states[-1] @ cost.terminal @ states[-1])


def events() -> None:
    print("event-triggered: input renewed only past the trigger; looked at every 5 ms for 10 s")
    for name in ("rover", "springless-rover", "double-integrator-2d", "unstable", "cart-pole"):
        system = load(name, noise=0.0)
        states, inputs = recorded(system, [0])
        regulator = learn(system, states[0], inputs[0])[0].learned()
        cost = system.cost
        triggers: list[tuple[str, Trigger]] = [
            (f"d'Rd, share {share:g}", QuadraticTrigger(cost, share)) for share in (0.01, 0.05, 0.2)
        ]
        triggers.append(("norms, decay 0.9", NormTrigger(cost, 0.9)))
        for label, trigger in triggers:
            excess, updates, looks = intermittent(system, regulator, trigger, 0.005)
            print(
                f"{name:21s} {label:18s}: {updates:4d} of {looks} updates "
                f"({1 - updates / looks:.1%} saved), cost {excess:+.2%}"
            )


def times(out: Path | None = None) -> None:
    print("CPU time, median of 30: one update (a window), one sweep over 10 s")
    sizes = (1, 2, 4, 6, 8, 10, 12, 16, 20)
    updates, sweeps = [], []
    for n in sizes:
        m = max(1, n // 2)
        update, sweep = time_of(n, m)
        updates.append(update)
        sweeps.append(sweep)
        print(f"n = {n:2d}, m = {m:2d}: update {1e6 * update:8.1f} us, sweep {1e3 * sweep:7.2f} ms")
    if out is not None:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
        axes.loglog(sizes, updates, "o-", color="#0072B2", label="update (one window)")
        axes.loglog(sizes, sweeps, "s-", color="#D55E00", label="backward sweep")
        axes.set_xlabel("states n (inputs n/2)")
        axes.set_ylabel("CPU seconds")
        axes.legend()
        figure.savefig(out / "q-learning-times.png", dpi=110)
        plt.close(figure)


def time_of(n: int, m: int, repetitions: int = 30) -> tuple[float, float]:
    """Median CPU seconds of an update and of a sweep for a random stable plant."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n)) / np.sqrt(n)
    A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(n)
    B = rng.normal(size=(n, m))
    data = WindowRegression(n, m, 0.01, SUBSTEPS, 1, 1.0)
    plant = LinearPlant(A, B)
    holds = data.p + 2 * repetitions
    states, inputs = probed_motions(
        plant, rng.normal(size=n), holds * SUBSTEPS * 0.01, 0.01, SUBSTEPS, 1.0, 0 * B.T, 0.0, [0]
    )
    first = data.p + repetitions
    data.absorb(states[0][: first * SUBSTEPS + 1], inputs[0][:first])
    seconds = [
        data.absorb(states[0][k * SUBSTEPS : (k + 1) * SUBSTEPS + 1], inputs[0][k : k + 1])
        for k in range(first, first + repetitions)
    ]
    cost = QuadraticCost(10 * np.eye(n), 2 * np.eye(m), 0.5 * np.eye(n), 10.0)
    theta = exact_map(A, B)
    sweeps = []
    for _ in range(repetitions):
        begun = thread_time()
        solve_backward(cost, theta, False)
        sweeps.append(thread_time() - begun)
    return float(np.median(seconds)), float(np.median(sweeps))


def exact_map(A: Array, B: Array) -> Array:
    """Theta `[p, q]` of a known plant."""
    n, m = B.shape
    rows, columns = np.triu_indices(n)
    q = len(rows)
    theta = np.zeros((q + m * n, q))
    for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
        P = np.zeros((n, n))
        P[i, j] = P[j, i] = 1.0 if i == j else 0.5
        H = A.T @ P + P @ A
        theta[:q, k] = H[rows, columns] * np.where(rows == columns, 1.0, 2.0)
        theta[q:, k] = 2.0 * (B.T @ P).ravel()
    return theta


def benchmarks() -> None:
    print("cost from the start over the optimum of the 10 s horizon, minus 1")
    print(f"{'system':22s} {'learned':>10s} {'identified':>10s} {'K(inf)':>10s} {'u = 0':>10s}")
    for name in shipped_systems():
        system = load(name, noise=0.0)
        plant, cost, exact = plant_of(system), system.cost, system.exact()
        states, inputs = recorded(system, [0])
        learned = learn(system, states[0], inputs[0])[0].learned()
        identified = identify(states[0], inputs[0], system.sample_period).riccati(cost)
        stationary = algebraic_riccati(system.problem)
        best = float(exact.value(system.start))

        def excess(gain: Callable[[Array], Array]) -> float:
            return regulated_costs(plant, cost, gain, system.start)[0][0] / best - 1  # noqa: B023

        nothing = np.zeros((system.problem.m, system.problem.n))
        values = [
            excess(learned.gain),
            excess(identified.gain),
            excess(stationary.gain),
            excess(lambda t: np.broadcast_to(nothing, (*np.shape(t), *nothing.shape))),  # noqa: B023
        ]
        print(f"{name:22s} " + " ".join(f"{value:10.2g}" for value in values))


def picture(out: Path | None = None) -> None:
    """What `zermelo regulate` draws of a noisy cart-pole."""
    from sims.regulation.figure import draw_regulation
    from sims.regulation.regulate import run

    result = run(load("cart-pole", noise=1e-3, data_seconds=10.0))
    print(f"cart-pole, noise 1e-3, 10 s of data: {result.report()}")
    if out is not None:
        draw_regulation(result).savefig(out / "regulate-cart-pole.png", dpi=80)


def main() -> None:
    parts: dict[str, Callable[[Path | None], None]] = {
        "noise-free": lambda _: noise_free(),
        "noise": lambda _: noise(),
        "random": lambda _: random_systems(),
        "laws": laws,
        "slips": lambda _: slips(),
        "events": lambda _: events(),
        "times": times,
        "benchmarks": lambda _: benchmarks(),
        "picture": picture,
    }
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=[*parts, "all"])
    parser.add_argument("--out", type=Path, default=None, help="folder for pictures")
    arguments = parser.parse_args()
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    for name, part in parts.items():
        if arguments.part in (name, "all"):
            part(arguments.out)


if __name__ == "__main__":
    main()
