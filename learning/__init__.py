"""Learned values and policies. Names are imported when first asked for: torch is heavy."""

from typing import TYPE_CHECKING

from ocp.lazy import lazy_names

if TYPE_CHECKING:
    from learning.meta_planner import MetaPlanner

_HOMES = {"MetaPlanner": "meta_planner"}

__all__ = ["MetaPlanner"]

__getattr__ = lazy_names(__name__, _HOMES)
