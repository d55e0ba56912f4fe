"""`zermelo regulate`: learn to regulate an unknown linear plant, the exact Riccati solution beside.

The learner meets the plant as a Drake Diagram for `data_seconds`, seeing sampled states and its own
inputs. Then its gains are frozen and run afresh from the start, without probing.
"""

import json
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.certificate import certify, relative_gain_error
from learning.q_learning.learned_regulator import LearnedRegulator
from learning.q_learning.learner import LearnerSettings, QLearner
from learning.q_learning.paper_law import LITERAL, REPAIRED, PaperLaw, PaperSettings
from learning.q_learning.window_regression import WindowRegression
from ocp.files import atomic_path, write_text
from ocp.riccati import DifferentialRiccati
from sims.regulation.simulation import (
    LinearPlant,
    Motion,
    drake_motion,
    regulated_costs,
    streams,
)
from sims.regulation.system_file import SystemFile

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

LEARNERS = ("q-learning", "paper-literal", "paper-repaired")
SUBSTEPS = 4
NOISY_WINDOW = 1.0
"""Seconds of a regression window when states are measured with noise."""
GRID = 101
CONVERGED = 0.1
"""The paper's laws give no certificate: this measured gain error decides."""
HISTORY = 60
"""Looks at the learner during its data, for the figure."""


@dataclass
class History:
    """What the learner knew over time.

    Attributes:
        times: `[k]`, seconds of data.
        gain_errors: `[k]`, measured against Riccati; infinite before there is a gain.
        claims: `[k]`, as certified from the data; infinite where nothing is claimed.
        conditions: `[k]`, of the scaled regressors (infinite for the paper's laws).
        excitations: `[k]`: rank over required rank; beta of Lemma 4.2 for the paper's laws.
        weights: `[k, w]`, the learned parameters.
        bounds: what the paper's gain bound (25) says at each look (its laws only).
    """

    times: list[float] = field(default_factory=list)
    gain_errors: list[float] = field(default_factory=list)
    claims: list[float] = field(default_factory=list)
    conditions: list[float] = field(default_factory=list)
    excitations: list[float] = field(default_factory=list)
    weights: list[Array] = field(default_factory=list)
    bounds: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Regulation:
    """One run of `zermelo regulate`.

    Attributes:
        system: what was asked.
        learner: its name.
        exact: the optimal regulator.
        history: of the learning.
        motion: the plant while it was learned, in Drake.
        gain: the learned K at times `[k]`, as `[k, m, n]`; `None` if nothing was learned.
        gain_error: against Riccati on a uniform grid over the horizon; `None` without a gain.
        cost, optimal_cost: from the start, with the one half of the paper's (2); `None` where the
            plant was not learned or the motion blew up.
        rank, required_rank: of the regressors.
        update_time: median CPU seconds of an update; for q-learning of the compiled regression,
            the run's data replayed window by window.
        converged: the certificate holds; for the paper's laws, the measured gain error is small.
        reason: why it did not converge; empty if it did.
    """

    system: SystemFile
    learner: str
    exact: DifferentialRiccati
    history: History
    motion: Motion
    gain: Callable[[Array], Array] | None
    gain_error: float | None
    cost: float | None
    optimal_cost: float
    rank: int
    required_rank: int
    update_time: float | None
    converged: bool
    reason: str

    def report(self) -> dict[str, Any]:
        """The JSON document of `zermelo regulate --json`."""
        excess = None
        if self.cost is not None and self.optimal_cost > 0:
            excess = self.cost / self.optimal_cost - 1
        return {
            "learner": self.learner,
            "gain_error": self.gain_error,
            "cost": self.cost,
            "optimal_cost": self.optimal_cost,
            "excess": excess,
            "data_seconds": float(self.system.data_seconds),
            "rank": self.rank,
            "required_rank": self.required_rank,
            "update_time_s": self.update_time,
            "converged": self.converged,
        }


def regulate(
    system_file: str | os.PathLike[str],
    learner: str = "q-learning",
    seed: int = 0,
    out: Path | None = None,
) -> dict[str, Any]:
    """Run `zermelo regulate`; returns its JSON document. With `out`, pictures and data go there.

    Raises:
        ValueError: if the file or the learner's name is wrong.
        OSError: if the file cannot be read or `out` not written.
    """
    if learner not in LEARNERS:
        raise ValueError(f"learner: must be one of {', '.join(LEARNERS)}, got {learner!r}")
    looks = 1 if out is None else HISTORY
    result = run(SystemFile.load(system_file), learner, seed, looks)
    if not result.converged:
        log.warning("%s did not converge: %s", learner, result.reason)
    if out is not None:
        save(result, out)
    return result.report()


def run(
    system: SystemFile, learner: str = "q-learning", seed: int = 0, looks: int = HISTORY
) -> Regulation:
    """Learn a system and judge what was learned, with so many looks at the learner on the way."""
    probing, noise = streams(seed)
    exact = system.exact()
    history = History()
    plant = LinearPlant(system.problem.A, system.problem.B)
    student: QLearner | PaperLaw
    if learner == "q-learning":
        student = QLearner(system.cost, learner_settings(system), probing)
        watch = _watch_learner(student, exact, history)
    else:
        slips = LITERAL if learner == "paper-literal" else REPAIRED
        law = PaperLaw(system.cost, paper_settings(system), probing, slips)
        log.info("before the run: %s", law.gain_bound())
        watch = _watch_law(law, exact, history)
        student = law
    period = system.sample_period
    samples = round(system.data_seconds / period)
    look = max(1, samples // looks)
    watched = _Watched(student, system.cost.horizon, period, look, watch)
    motion = drake_motion(
        plant, watched, system.start, samples * period, period, system.noise, noise
    )
    watch(samples * period)
    optimal = 0.5 * float(exact.value(system.start))
    if isinstance(student, QLearner):
        certificate = student.certify()
        gain = student.regulator.gain if student.regulator is not None else None
        rank, required = certificate.excitation.rank, certificate.excitation.required_rank
        update_time = _replayed_update_time(student, motion)
        converged, reason = certificate.holds, certificate.reason
    else:
        gain = None if student.diverged else student.gain
        rank, required = student.excited_rank(), len(student.critic)
        update_time = float(np.median(student.update_times)) if student.update_times else None
        converged, reason = False, "its weights diverged" if student.diverged else ""
        log.info("after the run: %s", history.bounds[-1])
        refused = sum("below" not in text for text in history.bounds)
        log.info("alpha_a was inadmissible at %d of %d looks", refused, len(history.bounds))
        if student.excitation() == 0:
            log.info("the excitation of Lemma 4.2 was not persistent: beta = 0")
    error, cost = None, None
    if gain is not None:
        error = _gain_error(gain, exact)
        cost = 0.5 * float(regulated_costs(plant, system.cost, gain, system.start)[0][0])
        cost = cost if np.isfinite(cost) else None
        if isinstance(student, PaperLaw):
            converged = error <= CONVERGED
            reason = "" if converged else f"its gain is off by {error:.2g} (u = 0 would be by 1)"
    return Regulation(
        system,
        learner,
        exact,
        history,
        motion,
        gain,
        error,
        cost,
        optimal,
        rank,
        required,
        update_time,
        converged,
        reason,
    )


def learner_settings(system: SystemFile) -> LearnerSettings:
    """How the system is probed: through all of its data; long windows only against noise."""
    hold = SUBSTEPS * system.sample_period
    holds = int(round(system.data_seconds / system.sample_period) // SUBSTEPS)
    n, m = system.problem.n, system.problem.m
    unknowns = n * (n + 1) // 2 + m * n
    longest = max(1, (holds - 2 * unknowns) // 2)
    window = 1 if system.noise == 0 else min(longest, max(1, round(NOISY_WINDOW / hold)))
    return LearnerSettings(
        sample_period=system.sample_period,
        substeps=SUBSTEPS,
        window=window,
        probing=system.probing,
        behaviour_gain=system.behaviour_gain,
        probe_throughout=True,
        check_every=10**9,
    )


def paper_settings(system: SystemFile) -> PaperSettings:
    """The paper's gains; Delta t is 50 ms or the nearest multiple of the sample period."""
    steps = max(1, round(0.05 / system.sample_period))
    return PaperSettings(
        sample_period=system.sample_period,
        resolution=steps * system.sample_period,
        probing=system.probing,
    )


def save(result: Regulation, out: Path) -> None:
    """Write the figure, the document and the arrays behind them to `out`."""
    from sims.regulation.figure import draw_regulation

    out.mkdir(parents=True, exist_ok=True)
    figure = draw_regulation(result)
    with atomic_path(out / "regulate.png") as path:
        figure.savefig(path, dpi=130)
    write_text(out / "regulate.json", json.dumps(result.report(), indent=2) + "\n")
    times = np.linspace(0.0, result.system.cost.horizon, GRID)
    arrays = {
        "gain_times": times,
        "exact_gain": result.exact.gain(times),
        "history_times": np.array(result.history.times),
        "gain_errors": np.array(result.history.gain_errors),
        "claims": np.array(result.history.claims),
        "conditions": np.array(result.history.conditions),
        "times": result.motion.times,
        "states": result.motion.states,
        "inputs": result.motion.inputs,
    }
    if result.gain is not None:
        arrays["gain"] = result.gain(times)
    with atomic_path(out / "regulate.npz") as path:
        np.savez_compressed(path, allow_pickle=False, **arrays)


class _Watched:
    """A student that is looked at every so many samples and given a new leg every horizon."""

    def __init__(
        self,
        student: QLearner | PaperLaw,
        horizon: float,
        period: float,
        look: int,
        watch: Callable[[float], None],
    ) -> None:
        self._student, self._look, self._watch = student, look, watch
        self._period, self._leg = period, round(horizon / period)
        self._count = 0

    def control(self, state: ArrayLike) -> Array:
        # The paper's weights are functions of the time within a horizon.
        if isinstance(self._student, PaperLaw) and self._count and self._count % self._leg == 0:
            self._student.new_leg()
        if self._count and self._count % self._look == 0:
            self._watch(self._count * self._period)
        self._count += 1
        return self._student.control(state)


def _replayed_update_time(learner: QLearner, motion: Motion) -> float | None:
    """Measured apart from the simulator, whose own work would leave the caches cold."""
    settings, substeps = learner.settings, learner.settings.substeps
    fresh = WindowRegression(
        learner.cost.n, learner.cost.m, settings.sample_period, substeps, settings.window, 1.0
    )
    states, inputs = motion.measured, motion.inputs
    starts = range(0, len(states) - substeps, substeps)
    seconds = [fresh.absorb(states[k : k + substeps + 1], inputs[k : k + 1]) for k in starts]
    return float(np.median(seconds)) if seconds else None


def _gain_error(gain: Callable[[Array], Array], exact: DifferentialRiccati) -> float:
    times = np.linspace(0.0, exact.horizon, GRID)
    return relative_gain_error(gain(times), exact.gain(times))


def _watch_learner(
    learner: QLearner, exact: DifferentialRiccati, history: History
) -> Callable[[float], None]:
    def watch(time: float) -> None:
        settings = learner.settings
        certificate, regulator = certify(
            learner.data, learner.cost, False, settings.largest_condition, settings.accuracy
        )
        excitation = certificate.excitation
        history.times.append(time)
        history.claims.append(certificate.gain_error)
        history.conditions.append(excitation.condition)
        history.excitations.append(excitation.rank / excitation.required_rank)
        known: LearnedRegulator | None = regulator
        history.gain_errors.append(_gain_error(known.gain, exact) if known is not None else np.inf)
        unknown = np.full(learner.data.p * learner.data.q, np.nan)
        history.weights.append(known.theta.ravel() if known is not None else unknown)

    return watch


def _watch_law(
    law: PaperLaw, exact: DifferentialRiccati, history: History
) -> Callable[[float], None]:
    def watch(time: float) -> None:
        history.times.append(time)
        history.gain_errors.append(np.inf if law.diverged else _gain_error(law.gain, exact))
        history.claims.append(np.inf)
        history.conditions.append(np.inf)
        history.excitations.append(law.excitation())
        history.weights.append(np.concatenate([law.critic, law.actor.ravel()]))
        history.bounds.append(str(law.gain_bound()))

    return watch


def names(system: SystemFile) -> tuple[Sequence[str], Sequence[str]]:
    """Labels of states and inputs."""
    n, m = system.problem.n, system.problem.m
    return [f"x{i + 1}" for i in range(n)], [f"u{i + 1}" for i in range(m)]
