"""System + Query -> compiled functions: dynamics, running cost, Hamiltonian flow and its Jacobian.

The source is generated from the CasADi graphs, written to a file named by a hash of its content
(so that it can never be stale), imported, and cached on disk by numba. The numbers of a query are
parameters: all queries of a family share one compiled kernel.

Minimising H(x, u, p) = W(x) + u' R u + p' (f + G u) over the input box gives
u*_i = clip(-(G' p)_i / (2 R_ii)); the minimised Hamiltonian's flow is x' = dH/dp, p' = -dH/dx.
"""

import importlib
import re
import sys
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from types import ModuleType
from typing import Any

from ocp.compiled.jit import cache_folder
from ocp.compiled.kernel_source import kernel_source
from ocp.compiled.parameters import Layout, parameters
from ocp.files import write_text
from ocp.query import Query
from ocp.system import System

__all__ = ["Kernels", "kernels", "parameters"]


@dataclass(frozen=True)
class Kernels:
    """Compiled functions of one robot and form of cost; `q` is the `parameters` of a query.

    Attributes:
        dynamics: (x `[n]`, u `[m]`, out `[n]`): x'.
        optimal_input: (z = [x, p] `[2n]`, q, out `[m]`): u*.
        flow: (z, q, out `[2n]`): [x', p'].
        flow_jacobian: (z, q, out `[2n]`, jacobian `[2n, 2n]`): the flow and its Jacobian in z.
        state_cost: (x, q) -> W(x).
        state_cost_derivatives: (x, q, gradient `[n]`, hessian `[n, n]`): of W.
        minimised_hamiltonian: (z, q) -> min_u H.
        running_cost: (xu = [x, u] `[n + m]`, q) -> L(x, u).
    """

    dynamics: Any
    optimal_input: Any
    flow: Any
    flow_jacobian: Any
    state_cost: Any
    state_cost_derivatives: Any
    minimised_hamiltonian: Any
    running_cost: Any


def kernels(query: Query) -> Kernels:
    """The compiled kernels for a query; compiled once for each robot and form of cost."""
    return _kernels(query.system, Layout.of(query))


@cache
def _kernels(system: System, layout: Layout) -> Kernels:
    module = _load(kernel_source(system, layout), system.name)
    return Kernels(**{name: getattr(module, name) for name in Kernels.__dataclass_fields__})


def _load(source: str, label: str) -> ModuleType:
    digest = sha256(source.encode()).hexdigest()[:24]
    folder = cache_folder() / "kernels"
    stem = re.sub(r"\W", "_", label)
    path = folder / f"kernels_of_{stem}_{digest}.py"
    if not path.exists():
        write_text(path, source)
    sys.path.insert(0, str(folder))  # numba's cache imports the module by name
    try:
        return importlib.import_module(path.stem)
    finally:
        sys.path.remove(str(folder))
