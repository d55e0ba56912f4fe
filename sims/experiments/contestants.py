"""The methods that the tables and figures compare: the paper's rows, and ours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.planning import Answer, OneShot, Planner, Until, never, trajectories
from ocp.query import Query
from ocp.query_family import PAPER_GOALS
from sims.closed_loop import LoopSettings
from sims.methods import METHODS, trained_by_trpo


@dataclass(frozen=True)
class Contestant:
    """A method at one setting.

    Attributes:
        key: names it in files.
        label: names its row.
        method: the name of the method in `sims.methods.METHODS`; absent where that is. Empty for
            one that has no name there.
        planner: makes it.
        until: when it stops; by default when it has nothing left to refine.
        row: of the paper's Table I, if it is one.
        period: seconds for which its inputs are held; by default the method's.
        slow: left out of quick runs.
        note: the reading or settings that its figures rest on.
        only: the goals of the paper's queries that it is for; by default all.
    """

    key: str
    label: str
    method: str
    planner: Callable[[], Planner]
    until: Until
    row: str | None = None
    period: float | None = None
    slow: bool = False
    note: str = ""
    only: tuple[tuple[float, float], ...] = PAPER_GOALS

    @property
    def held(self) -> float:
        """Seconds for which its inputs are held."""
        if self.period is not None:
            return self.period
        return METHODS[self.method].period if self.method else LoopSettings().period

    @property
    def absent(self) -> str | None:
        """Why it cannot be run, or `None` if it can."""
        if self.method and self.method not in METHODS:
            return f"{self.method} is not implemented"
        try:
            self.planner()
        except (ImportError, FileNotFoundError) as error:
            return str(error)
        return None

    @property
    def config(self) -> dict[str, Any]:
        """What its figures depend on, for the parts."""
        return {"contestant": self.key, "note": self.note, "period": self.period}


NEVER = never()
EIGHT = trajectories(8)


def _registered(name: str) -> Callable[[], Planner]:
    return lambda: METHODS[name].planner()


def _set_valued(shape: str, feedback: str) -> Callable[[], Planner]:
    def make() -> Planner:
        from ocp import set_valued
        from ocp.grid import Grid

        coarse = shape == "coarse"
        settings = set_valued.SetValuedSettings(step=0.4 if coarse else 0.2)

        def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
            grid = Grid.of(query.system, set_valued.COARSE if coarse else set_valued.FINE)
            solution = set_valued.solve_set_valued(query, grid, settings)
            nearest = feedback == "nearest"
            policy = solution.nearest_node_policy() if nearest else solution.policy()
            return policy, solution.value

        return OneShot(solve)

    return make


def _trpo_alone() -> Planner:
    from learning.trpo.policy import TRAINED_ALONE

    return trained_by_trpo(TRAINED_ALONE)


def _refmm(simplices: int) -> Callable[[], Planner]:
    def make() -> Planner:
        from ocp.refmm import Refmm, RefmmSettings

        return Refmm(RefmmSettings(last=simplices))

    return make


def _eikonal(nodes: int) -> Callable[[], Planner]:
    def make() -> Planner:
        from ocp.eikonal import solve_eikonal

        def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
            solution = solve_eikonal(query, nodes=nodes)
            return solution.policy(), solution.value

        return OneShot(solve)

    return make


def _faithful(stem: str) -> Callable[[], Any]:
    def make() -> Any:
        from learning.faithful.meta import MetaWeights
        from learning.faithful.planner import FaithfulPlanner
        from learning.shipped import PRETRAINED

        path = PRETRAINED / f"{stem}.safetensors"
        if not path.is_file():
            raise FileNotFoundError("no trained weights are shipped for the paper's meta learning")
        return FaithfulPlanner(MetaWeights.load(path))

    return make


CONTESTANTS = (
    Contestant(
        "set-valued-fine",
        "Set-valued method (fine grid)",
        "set-valued",
        _set_valued("fine", "lookahead"),
        NEVER,
        "Set-valued method (fine grid)",
        note="eq. (7), nearest node as image, 116 x 116 x 71, eps 0.2 s; interpolated lookahead",
    ),
    Contestant(
        "set-valued-coarse",
        "Set-valued method (coarse grid)",
        "set-valued",
        _set_valued("coarse", "lookahead"),
        NEVER,
        "Set-valued method (coarse grid)",
        note="eq. (7), nearest node as image, 58 x 58 x 35, eps 0.4 s; interpolated lookahead",
    ),
    Contestant(
        "set-valued-nearest",
        "Set-valued method (coarse grid, nearest-node feedback)",
        "set-valued",
        _set_valued("coarse", "nearest"),
        NEVER,
        None,
        0.05,
        note="the same values; the control stored at the nearest node, held 0.05 s, as the paper's "
        "coarse row seems to be made",
    ),
    Contestant(
        "refmm-fine",
        "ReFMM (fine grid)",
        "refmm",
        _refmm(96_000),
        NEVER,
        "ReFMM (fine grid)",
        slow=True,
        note="96,000 simplices",
    ),
    Contestant(
        "refmm-coarse",
        "ReFMM (coarse grid)",
        "refmm",
        _refmm(12_000),
        NEVER,
        "ReFMM (coarse grid)",
        note="12,000 simplices",
    ),
    Contestant(
        "mpc",
        "MPC",
        "mpc",
        _registered("mpc"),
        NEVER,
        "MPC",
        note="20 steps of 0.1 s, quadratic cost at the end: 0.3 times the squared distance, "
        "the best of seven weights (zermelo bench mpc)",
    ),
    Contestant(
        "mpc-value",
        "MPC, eikonal value at the end",
        "mpc-value",
        _registered("mpc-value"),
        NEVER,
        note="20 steps of 0.1 s, the spline of the eikonal value at the end",
    ),
    Contestant(
        "trpo",
        "TRPO",
        "trpo",
        _registered("trpo"),
        NEVER,
        "TRPO",
        note="one policy for the whole family, about a million steps; the paper trains one a query",
    ),
    Contestant(
        "trpo-alone",
        "TRPO, trained for (1, 1) alone",
        "",
        _trpo_alone,
        NEVER,
        period=METHODS["trpo"].period,
        note="the settings and steps of the policy for the whole family",
        only=((1.0, 1.0),),
    ),
    Contestant(
        "interpolation",
        "DNN interpolation",
        "interpolation",
        _registered("interpolation"),
        NEVER,
        "DNN interpolation",
        slow=True,
        note="section III-A2 on the coarse grid's values",
    ),
    Contestant(
        "faithful",
        "Anytime adaptation",
        "",
        _faithful("faithful"),
        EIGHT,
        "Anytime adaptation",
        note="Algorithms 1 and 2 as printed, n = 8",
    ),
    Contestant(
        "repaired",
        "Anytime adaptation (repaired)",
        "",
        _faithful("repaired"),
        EIGHT,
        note="Algorithms 1 and 2 with the departures of learning/configs/repaired.toml, n = 8",
    ),
    Contestant(
        "anytime",
        "Anytime adaptation (any-time settings)",
        "",
        _faithful("anytime"),
        EIGHT,
        note="Algorithms 1 and 2 with the settings of learning/configs/anytime.toml, n = 8",
    ),
    Contestant(
        "adapt",
        "adapt (ours)",
        "adapt",
        _registered("adapt"),
        EIGHT,
        note="the default method: conditioned network, exact trajectories, then grids; n = 8",
    ),
    Contestant(
        "eikonal",
        "eikonal (ours)",
        "eikonal",
        _eikonal(60_000),
        NEVER,
        note="fast marching, 60,000 nodes; interpolated lookahead",
    ),
)


def contestant(key: str) -> Contestant:
    """The contestant called `key`."""
    return next(c for c in CONTESTANTS if c.key == key)
