"""Closed loops, scenarios, experiments, figures and the command line."""

from typing import TYPE_CHECKING

from ocp.lazy import lazy_names

if TYPE_CHECKING:
    from sims.closed_loop import LoopSettings, Rollout, drake_rollout, rollout, rollouts

_HOMES = {
    "LoopSettings": "closed_loop",
    "Rollout": "closed_loop",
    "drake_rollout": "closed_loop",
    "rollout": "closed_loop",
    "rollouts": "closed_loop",
}

__all__ = ["LoopSettings", "Rollout", "drake_rollout", "rollout", "rollouts"]

__getattr__ = lazy_names(__name__, _HOMES)
