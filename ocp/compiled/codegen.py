"""CasADi expression graphs to Python source that numba compiles.

A CasADi call from Python costs some 25 microseconds; the same graph compiled, a tenth of one.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np

UNARY = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_SQRT: "math.sqrt({0})",
    ca.OP_EXP: "math.exp({0})",
    ca.OP_LOG: "math.log({0})",
    ca.OP_LOG1P: "math.log1p({0})",
    ca.OP_EXPM1: "math.expm1({0})",
    ca.OP_SIN: "math.sin({0})",
    ca.OP_COS: "math.cos({0})",
    ca.OP_TAN: "math.tan({0})",
    ca.OP_ASIN: "math.asin({0})",
    ca.OP_ACOS: "math.acos({0})",
    ca.OP_ATAN: "math.atan({0})",
    ca.OP_SINH: "math.sinh({0})",
    ca.OP_COSH: "math.cosh({0})",
    ca.OP_TANH: "math.tanh({0})",
    ca.OP_FABS: "abs({0})",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_FLOOR: "math.floor({0})",
    ca.OP_CEIL: "math.ceil({0})",
    ca.OP_SIGN: "(1.0 if {0} > 0.0 else (-1.0 if {0} < 0.0 else 0.0))",
    ca.OP_NOT: "(1.0 if {0} == 0.0 else 0.0)",
    ca.OP_ASSIGN: "{0}",
}

BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_POW: "{0} ** {1}",
    ca.OP_CONSTPOW: "{0} ** {1}",
    ca.OP_ATAN2: "math.atan2({0}, {1})",
    ca.OP_HYPOT: "math.hypot({0}, {1})",
    ca.OP_COPYSIGN: "math.copysign({0}, {1})",
    ca.OP_FMIN: "({0} if {0} < {1} else {1})",
    ca.OP_FMAX: "({0} if {0} > {1} else {1})",
    ca.OP_LT: "(1.0 if {0} < {1} else 0.0)",
    ca.OP_LE: "(1.0 if {0} <= {1} else 0.0)",
    ca.OP_EQ: "(1.0 if {0} == {1} else 0.0)",
    ca.OP_NE: "(1.0 if {0} != {1} else 0.0)",
    ca.OP_AND: "(1.0 if {0} != 0.0 and {1} != 0.0 else 0.0)",
    ca.OP_OR: "(1.0 if {0} != 0.0 or {1} != 0.0 else 0.0)",
    ca.OP_IF_ELSE_ZERO: "({1} if {0} != 0.0 else 0.0)",
}


def statements(function: ca.Function, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Python statements that evaluate an SX `function` with dense inputs and outputs.

    Args:
        function: its non-zeros are numbered column by column, as CasADi stores them.
        inputs: a template for each input, such as `"x[{0}]"`; `{0}` is the non-zero's number.
        outputs: likewise for each output.

    Raises:
        ValueError: if an input or output is sparse, or an operation has no translation.
    """
    for i in range(function.n_in()):
        if not function.sparsity_in(i).is_dense():
            raise ValueError(f"{function.name()}: input {i} is sparse")
    for i in range(function.n_out()):
        if not function.sparsity_out(i).is_dense():
            raise ValueError(f"{function.name()}: output {i} is sparse")
    lines = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            line = f"w{targets[0]} = {inputs[sources[0]].format(sources[1])}"
        elif operation == ca.OP_OUTPUT:
            line = f"{outputs[targets[0]].format(targets[1])} = w{sources[0]}"
        elif operation == ca.OP_CONST:
            line = f"w{targets[0]} = {_literal(function.instruction_constant(k))}"
        elif operation in UNARY:
            line = f"w{targets[0]} = {UNARY[operation].format(f'w{sources[0]}')}"
        elif operation in BINARY:
            a, b = (f"w{s}" for s in sources)
            line = f"w{targets[0]} = {BINARY[operation].format(a, b)}"
        else:
            raise ValueError(f"{function.name()}: CasADi operation {operation} has no translation")
        lines.append(line)
    return lines


def _literal(number: float) -> str:
    if number != number or abs(number) == float("inf"):
        return f'float("{number}")'
    return repr(float(number))


def interpreted(function: ca.Function, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Like `statements`, but as a loop over a table of operations.

    Compiling ten thousand statements takes numba a minute, a loop a second; the loop runs a few
    times slower. The lines are the body of a function of a module that imports numpy as `np`; the
    table is the line that begins with `TABLE`, for the module's top level.

    Raises:
        ValueError: if the graph holds an operation that has no translation.
    """
    rows, constants, used = [], [], []
    first_in = np.cumsum([0, *(function.nnz_in(i) for i in range(function.n_in()))])
    first_out = np.cumsum([0, *(function.nnz_out(i) for i in range(function.n_out()))])
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            row = [0, targets[0], first_in[sources[0]] + sources[1], 0]
        elif operation == ca.OP_OUTPUT:
            row = [1, first_out[targets[0]] + targets[1], sources[0], 0]
        elif operation == ca.OP_CONST:
            row = [2, targets[0], len(constants), 0]
            constants.append(function.instruction_constant(k))
        elif operation in UNARY or operation in BINARY:
            if operation not in used:
                used.append(operation)
            row = [3 + used.index(operation), targets[0], *sources, 0][:4]
        else:
            raise ValueError(f"{function.name()}: CasADi operation {operation} has no translation")
        rows.append([int(x) for x in row])
    name = function.name().upper()
    numbers = ", ".join(_literal(c) if np.isfinite(c) else "np.nan" for c in constants) or "0.0"
    table = ", ".join(map(str, np.ravel(rows)))
    lines = [
        f"TABLE {name} = np.array([{table}]).reshape(-1, 4)",
        f"TABLE {name}_CONSTANTS = np.array([{numbers}])",
        f"given = np.empty({first_in[-1]})",
        f"found = np.empty({first_out[-1]})",
        f"w = np.empty({function.sz_w()})",
    ]
    for i, template in enumerate(inputs):
        lines += [
            f"for j in range({function.nnz_in(i)}):",
            f"    given[{first_in[i]} + j] = {template.format('j')}",
        ]
    lines += [
        f"for k in range({len(rows)}):",
        f"    o, t, a, b = {name}[k, 0], {name}[k, 1], {name}[k, 2], {name}[k, 3]",
    ]
    cases = ["w[t] = given[a]", "found[t] = w[a]", f"w[t] = {name}_CONSTANTS[a]"]
    for operation in used:
        template = UNARY.get(operation) or BINARY[operation]
        cases.append(f"w[t] = {template.format('w[a]', 'w[b]')}")
    for i, case in enumerate(cases):
        lines += [f"    {'if' if i == 0 else 'elif'} o == {i}:", f"        {case}"]
    for i, template in enumerate(outputs):
        lines += [
            f"for j in range({function.nnz_out(i)}):",
            f"    {template.format('j')} = found[{first_out[i]} + j]",
        ]
    return lines
