"""What is claimed of Q-learning, measured: prints every figure that the documents quote.

`python -m sims.regulation.study PART [--out DIR]`; PART is noise-free, noise, random, laws, slips,
events, times, benchmarks, picture or all. Pictures go to DIR.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.certificate import relative_gain_error
from learning.q_learning.identification import identify
from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.riccati import LinearQuadratic, algebraic_riccati
from sims.regulation.regulate import SUBSTEPS
from sims.regulation.simulation import regulated_costs
from sims.regulation.study_events import events
from sims.regulation.study_laws import laws, slips
from sims.regulation.study_motions import (
    GRID,
    SEEDS,
    gain_errors,
    identification_errors,
    learn,
    load,
    plant_of,
    recorded,
)
from sims.regulation.study_times import times
from sims.regulation.system_file import SystemFile, shipped_systems

Array = NDArray[np.float64]

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
