"""The system file: a linear plant, its cost and how it is to be learned, in TOML, read strictly."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.query_file import read_toml
from ocp.riccati import DifferentialRiccati, LinearQuadratic, differential_riccati
from sims.toml_tables import number_of, numbers_of, rows_of

Array = NDArray[np.float64]

REQUIRED = ("A", "B", "M", "R", "terminal", "horizon", "start")
OPTIONAL = ("sample_period", "data_seconds", "probing", "noise", "behaviour_gain")


@dataclass(frozen=True, eq=False)
class SystemFile:
    """x' = A x + B u with its cost and the conditions of learning.

    Attributes:
        problem: A, B, M, R.
        cost: M, R, P_T and the horizon: all that a learner is told.
        start: `[n]`.
        sample_period: seconds between measured states.
        data_seconds: how long the learner probes and learns.
        probing: standard deviation of the probing input.
        noise: standard deviation added to every measured state.
        behaviour_gain: `[m, n]`, the feedback while learning; zero by default.

    Raises:
        ValueError: naming the field and what would be right; also if (A, B) is not controllable.
    """

    problem: LinearQuadratic
    cost: QuadraticCost
    start: Array
    sample_period: float = 0.01
    data_seconds: float = 2.0
    probing: float = 1.0
    noise: float = 0.0
    behaviour_gain: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        n, m = self.problem.n, self.problem.m
        for name in ("sample_period", "data_seconds"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: must be a positive number of seconds, got {value}")
        if self.data_seconds < self.sample_period:
            raise ValueError(
                f"data_seconds: must be at least sample_period {self.sample_period:g}, "
                f"got {self.data_seconds:g}"
            )
        for name in ("probing", "noise"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: must be non-negative and finite, got {value}")
        start = np.array(self.start, dtype=float)
        if start.shape != (n,) or not np.isfinite(start).all():
            raise ValueError(f"start: must be {n} finite numbers, got {start.tolist()}")
        object.__setattr__(self, "start", start)
        gain = np.array(self.behaviour_gain, dtype=float)
        gain = np.zeros((m, n)) if gain.size == 0 else gain
        if gain.shape != (m, n) or not np.isfinite(gain).all():
            raise ValueError(
                f"behaviour_gain: must be {m} rows of {n} finite numbers, got {gain.tolist()}"
            )
        object.__setattr__(self, "behaviour_gain", gain)
        need_controllable(self.problem.A, self.problem.B)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "SystemFile":
        """The system of a TOML file.

        Raises:
            ValueError: naming what is missing, unknown or wrong.
            OSError: if the file cannot be read.
        """
        return cls.from_dict(read_toml(path))

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> "SystemFile":
        """The system of a file's tables; unknown keys are refused."""
        for key in table:
            if key not in REQUIRED + OPTIONAL:
                known = ", ".join(REQUIRED + OPTIONAL)
                raise ValueError(f"{key}: unknown; known are {known}")
        for key in REQUIRED:
            if key not in table:
                raise ValueError(f"{key}: missing")
        matrices = {k: rows_of(table[k], k) for k in ("A", "B", "M", "R", "terminal")}
        problem = LinearQuadratic(*(matrices[k] for k in ("A", "B", "M", "R")))
        cost = QuadraticCost(
            matrices["M"],
            matrices["R"],
            matrices["terminal"],
            number_of(table["horizon"], "horizon"),
        )
        options: dict[str, Any] = {
            k: number_of(table[k], k)
            for k in ("sample_period", "data_seconds", "probing", "noise")
            if k in table
        }
        if "behaviour_gain" in table:
            options["behaviour_gain"] = rows_of(table["behaviour_gain"], "behaviour_gain")
        return cls(problem, cost, numbers_of(table["start"], "start"), **options)

    def exact(self) -> DifferentialRiccati:
        """The optimal regulator."""
        return differential_riccati(self.problem, self.cost.terminal, self.cost.horizon)


def shipped_systems() -> dict[str, Path]:
    """The system files that come with the package, by name."""
    folder = Path(str(resources.files("sims"))) / "systems"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def need_controllable(A: Array, B: Array) -> None:
    """Hautus: [A - s I, B] has full rank at every eigenvalue s of A (Assumption 1 of the paper).

    A is `[n, n]`, B `[n, m]`.

    Raises:
        ValueError: naming the mode that no input reaches.
    """
    n = len(A)
    size = np.linalg.norm(np.hstack([A, B]), 2)
    for s in np.linalg.eigvals(A):
        pencil = np.hstack([A - s * np.eye(n), B]).astype(complex)
        if np.linalg.svd(pencil, compute_uv=False)[-1] <= 1e-10 * size:
            raise ValueError(
                f"A, B: not controllable: no input reaches the mode with eigenvalue {s:.4g}"
            )
