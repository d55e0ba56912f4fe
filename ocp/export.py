"""Policies as dependency-free C99, for a robot's own computer.

    export_c(policy, "controller")          # controller/policy.c and policy.h

    void policy_input(const double state[n], double input[m]);

The C text is translated from the kernels that the policy runs (c_code/), so it is the
same policy, not a second one: there is no interpreter, no allocation but the stack, no library but
the C standard's mathematics.
"""

import os
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.c_code.statements import new_module
from ocp.compiled.function_address import ADDRESSES, address, function_at
from ocp.compiled.jit import KERNEL, MATRIX, VECTOR, compiled
from ocp.compiled.kernel_call import KernelCall
from ocp.files import write_text
from ocp.kernels import kernels, parameters
from ocp.regulation import RegulatorValue
from ocp.riccati import AlgebraicRiccati, QuadraticValue
from ocp.value import GreedyPolicy, Policy

Array = NDArray[np.float64]

kernel_at = function_at(KERNEL)


@dataclass(frozen=True)
class ExportedC:
    """Where a policy went.

    Attributes:
        source, header: the files.
        states, inputs: n and m.
    """

    source: Path
    header: Path
    states: int
    inputs: int


def export_c(
    policy: Policy | AlgebraicRiccati, folder: str | os.PathLike[str], name: str = "policy"
) -> ExportedC:
    """Write `name`.c and `name`.h into `folder`: C99 that computes what the policy does.

    Args:
        policy: a trained network's, a grid's lookahead, a policy greedy for a quadratic value
            (a regulator's, within the query's input bounds), or an `AlgebraicRiccati`, whose
            u = -K (x - x_g) counts from the input that holds the robot at x_g.
        folder: is made if need be.
        name: of the files, and of the function `name`_input.

    Raises:
        ValueError: for a policy that is not made of kernels, or a name that is none in C.
    """
    if not (name.isidentifier() and name.isascii()):
        raise ValueError(f"name: must be a C identifier, got {name!r}")
    call, n, m, label = _call_of(policy)
    text = _source(call, n, m, name, label)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    source, header = folder / f"{name}.c", folder / f"{name}.h"
    write_text(source, text)
    write_text(header, _header(n, m, name, label))
    return ExportedC(source, header, n, m)


def _call_of(policy: Any) -> tuple[KernelCall, int, int, str]:
    if isinstance(policy, AlgebraicRiccati):
        problem = policy.problem
        gain, centre = np.ascontiguousarray(policy.gain()), np.array(problem.reference, float)
        return KernelCall(_linear, (gain, centre)), problem.n, problem.m, "a linear regulator"
    call = _greedy(policy) if isinstance(policy, GreedyPolicy) else None
    call = call or getattr(policy, "kernel_call", None)
    if not isinstance(call, KernelCall):
        raise ValueError(
            f"policy: {type(policy).__name__} is not made of kernels; export a network's policy, a "
            "grid's lookahead, a greedy policy of a quadratic value, or a linear regulator"
        )
    system = policy.query.system
    return call, system.n, system.m, f"{type(policy).__name__} of {system.name}"


def _greedy(policy: GreedyPolicy) -> KernelCall | None:
    query, value = policy.query, policy.value
    if query.is_time_free:
        return None
    if isinstance(value, RegulatorValue):
        P, centre, period = value.P, query.reference, query.system.period
    elif isinstance(value, AlgebraicRiccati | QuadraticValue):
        algebraic = isinstance(value, AlgebraicRiccati)
        P = value.matrix if algebraic else value.P
        centre = value.problem.reference if algebraic else value.reference
        period = np.zeros(query.system.n)
    else:
        return None
    numbers = [np.ascontiguousarray(a, dtype=float) for a in (P, centre, period)]
    where = address(kernels(query).optimal_input)
    return KernelCall(_quadratic, (where, parameters(query), *numbers))


@compiled(types.void(MATRIX, VECTOR, MATRIX, MATRIX))
def _linear(gain, centre, states, inputs):
    """u = -K (x - c)."""
    for row in range(states.shape[0]):
        for j in range(inputs.shape[1]):
            inputs[row, j] = 0.0
            for i in range(states.shape[1]):
                inputs[row, j] -= gain[j, i] * (states[row, i] - centre[i])


@compiled(types.void(ADDRESSES, VECTOR, MATRIX, VECTOR, VECTOR, MATRIX, MATRIX))
def _quadratic(functions, q, P, centre, period, states, inputs):
    """The best input where grad V = 2 P (x - c), differences taken round where x is periodic."""
    optimal_input = kernel_at(functions[0, 0], functions[0, 1])
    n = states.shape[1]
    z, offset = np.empty(2 * n), np.empty(n)
    for row in range(states.shape[0]):
        for i in range(n):
            offset[i] = states[row, i] - centre[i]
            if period[i] > 0.0:
                offset[i] -= period[i] * np.round(offset[i] / period[i])
            z[i] = states[row, i]
            z[n + i] = 0.0
        for i in range(n):
            for j in range(n):
                z[n + i] += 2.0 * P[i, j] * offset[j]
        optimal_input(z, q, inputs[row])


def _source(call: KernelCall, n: int, m: int, name: str, label: str) -> str:
    module = new_module()
    (signature,) = call.function.nopython_signatures
    at_state = len(call.before)
    given = [*call.before, None, *call.after, None]
    fill, arguments = [], []
    for position, (kind, value) in enumerate(zip(signature.args, given, strict=True)):
        if value is None:
            here = f"(double *)state, {{1, {n}}}" if position == at_state else f"input, {{1, {m}}}"
            arguments.append(f"(doubles){{{here}}}")
        elif kind == ADDRESSES:
            code, lines = module.addressed(value, "functions")
            fill += lines
            arguments.append(code)
        elif isinstance(kind, types.Array):
            arguments.append(module.constant(value, "known"))
        else:
            arguments.append(repr(value))
    target = module.name_of(call.function)
    body = "\n".join(f"    {line}" for line in fill)
    return (
        f"/* {label}, exported by zermelo. Generated: do not edit.\n"
        f" *\n *     cc -std=c99 -O2 -c {name}.c        and link with -lm\n */\n"
        f'#include "{name}.h"\n#include <stdlib.h>\n{module.text()}\n'
        f"void {name}_input(const double *state, double *input)\n{{\n{body}\n"
        f"    {target}(\n" + textwrap.indent(",\n".join(arguments), " " * 8) + ");\n}\n"
    )


def _header(n: int, m: int, name: str, label: str) -> str:
    guard = f"{name.upper()}_H"
    return (
        f"/* {label}. */\n#ifndef {guard}\n#define {guard}\n\n"
        f"#define {name.upper()}_STATES {n}\n#define {name.upper()}_INPUTS {m}\n\n"
        '#ifdef __cplusplus\nextern "C" {\n#endif\n\n'
        f"/* The input [{m}] at a state [{n}], in SI units and radians. */\n"
        f"void {name}_input(const double *state, double *input);\n\n"
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
    )
