"""What renewing the input only when an event asks for it costs and saves."""

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.event_trigger import (
    IntermittentController,
    NormTrigger,
    QuadraticTrigger,
    Trigger,
)
from learning.q_learning.learned_regulator import LearnedRegulator
from learning.q_learning.quadratic_cost import QuadraticCost
from sims.regulation.simulation import LinearPlant, sampled_motion
from sims.regulation.study_motions import learn, load, plant_of, recorded
from sims.regulation.system_file import SystemFile

Array = NDArray[np.float64]


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
