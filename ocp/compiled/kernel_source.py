"""The source text of a robot's compiled kernels, generated from its CasADi expressions."""

import casadi as ca

from ocp import cost as costs
from ocp.compiled.codegen import interpreted, statements
from ocp.compiled.parameters import Layout
from ocp.system import System

LARGE = 4000
"""Operations beyond which a function is interpreted: compiling it would take a minute."""


def _symbol(name: str, *shape: int) -> ca.SX:
    return ca.SX.sym(name, *shape)  # pyright: ignore[reportCallIssue, reportArgumentType]


def kernel_source(system: System, layout: Layout) -> str:
    """The text of the generated module."""
    n, m = layout.n, layout.m
    x, u, p = system.state, _symbol("u", m), _symbol("p", n)
    weight, lower, upper = _symbol("R", m), _symbol("lower", m), _symbol("upper", m)

    rest = _symbol("rest", m) if layout.resting else ca.SX.zeros(m, 1)
    optimum = -(system.input_matrix.T @ p) / (2 * weight)
    if layout.resting:
        optimum += rest
    if layout.bounded:
        optimum = ca.fmin(ca.fmax(optimum, lower), upper)
    rate = system.drift + system.input_matrix @ u
    effort = u - rest if layout.resting else u
    hamiltonian = ca.dot(weight, effort**2) + ca.dot(p, rate)  # without W
    costate_rate = -ca.gradient(hamiltonian, x)
    flow = ca.substitute(ca.vertcat(rate, costate_rate), u, optimum)
    z = ca.vertcat(x, p)
    limits = [weight, lower, upper]
    limit_slots = ["q[{0}]", f"q[{m} + {{0}}]", f"q[{2 * m} + {{0}}]"]
    if layout.resting:
        limits.append(rest)
        limit_slots.append(f"q[{3 * m} + {{0}}]")

    def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
        return ca.Function(name, inputs, [ca.densify(o) for o in outputs])

    tables: list[str] = []

    def body(f: ca.Function, inputs: list[str], outputs: list[str]) -> str:
        large = f.n_instructions() > LARGE
        lines = (interpreted if large else statements)(f, inputs, outputs)
        tables.extend(line[6:] for line in lines if line.startswith("TABLE "))
        return "\n".join(f"    {line}" for line in lines if not line.startswith("TABLE "))

    state_and_costate = ["z[{0}]", f"z[{n} + {{0}}]"]
    parts = [
        f'"""Generated from the definition of {system.name}: do not edit."""\n',
        "import math\n\nimport numpy as np\n",
        "from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64, types\n",
        "KEY = __name__",
        _cost_source(system, layout),
        "@compiled(types.void(VECTOR, VECTOR, VECTOR), KEY)\ndef dynamics(x, u, out):",
        body(function("dynamics", [x, u], [rate]), ["x[{0}]", "u[{0}]"], ["out[{0}]"]),
        "\n@compiled(types.void(VECTOR, VECTOR, VECTOR), KEY)\ndef optimal_input(z, q, out):",
        body(
            function("optimal_input", [x, p, *limits], [optimum]),
            state_and_costate + limit_slots,
            ["out[{0}]"],
        ),
        "\n@compiled(types.void(VECTOR, VECTOR, VECTOR), KEY)\ndef flow(z, q, out):",
        body(
            function("flow", [x, p, *limits], [flow]),
            state_and_costate + limit_slots,
            ["out[{0}]"],
        ),
        f"    gradient = np.empty({n})",
        f"    hessian = np.empty(({n}, {n}))",
        "    state_cost_derivatives(z, q, gradient, hessian)",
        f"    for i in range({n}):\n        out[{n} + i] -= gradient[i]",
        "\n@compiled(types.void(VECTOR, VECTOR, VECTOR, MATRIX), KEY)",
        "def flow_jacobian(z, q, out, jacobian):",
        body(
            function("flow_jacobian", [x, p, *limits], [flow, ca.jacobian(flow, z).T]),
            state_and_costate + limit_slots,
            ["out[{0}]", f"jacobian[{{0}} // {2 * n}, {{0}} % {2 * n}]"],
        ),
        f"    gradient = np.empty({n})",
        f"    hessian = np.empty(({n}, {n}))",
        "    state_cost_derivatives(z, q, gradient, hessian)",
        f"    for i in range({n}):\n        out[{n} + i] -= gradient[i]",
        f"        for j in range({n}):\n            jacobian[{n} + i, j] -= hessian[i, j]",
        "\n@compiled(float64(VECTOR, VECTOR), KEY)\ndef minimised_hamiltonian(z, q):",
        body(
            function("minimised", [x, p, *limits], [ca.substitute(hamiltonian, u, optimum)]),
            state_and_costate + limit_slots,
            ["h"],
        ),
        "    return h + state_cost(z, q)",
        "\n@compiled(float64(VECTOR, VECTOR), KEY)\ndef running_cost(xu, q):",
        "    total = state_cost(xu, q)",
        f"    for i in range({m}):",
        f"        total += q[i] * (xu[{n} + i] - q[{3 * m} + i]) ** 2"
        if layout.resting
        else f"        total += q[i] * xu[{n} + i] ** 2",
        "    return total",
    ]
    parts[4:4] = tables
    return "\n".join(parts) + "\n"


def _cost_source(system: System, layout: Layout) -> str:
    """`state_cost` and `state_cost_derivatives`: smooth terms, then a loop over the obstacles."""
    n, d = layout.n, layout.d
    x = system.state
    position = x[list(system.position)]
    weight, steepness, radius = _symbol("w"), _symbol("a"), _symbol("r")
    center, facet = _symbol("c", d), _symbol("f", d)

    goal_slots = [
        f"q[{layout.goal} + {{0}}]",
        *(f"q[{layout.goal + d + k}]" for k in range(3)),
    ]
    smooth_inputs = [x, center, radius, weight, steepness]
    smooth_slots = ["x[{0}]", *goal_slots]
    smooth = costs.goal_cost(position, center, radius, weight, steepness)
    if layout.quadratic:
        reference, M = _symbol("xg", n), _symbol("M", n, n)
        smooth += costs.quadratic_cost(x, reference, M, system.period)
        smooth_inputs += [reference, M]
        smooth_slots += [f"q[{layout.state} + {{0}}]", f"q[{layout.state + n} + {{0}}]"]

    if layout.own_cost:
        smooth += costs.own_cost(layout.own_cost)(x)

    place = _symbol("p", d)
    ball = costs.ball_penalty(place, center, radius, weight, steepness)
    scale = [f"q[{layout.goal + d + 3}]", f"q[{layout.goal + d + 4}]"]
    positions = "x[{0}]" if system.position == tuple(range(d)) else None
    if positions is None:
        raise ValueError(f"system {system.name!r}: position coordinates must come first")
    ball_inputs = [place, center, radius, weight, steepness]
    ball_slots = [positions, "q[k + 2 + {0}]", "q[k + 1]", *scale]

    def code(name: str, inputs: list[ca.SX], slots: list[str], w: ca.SX, by: ca.SX, indent: int):
        """Statements for the value alone, and for value, gradient and Hessian in `by`."""
        hessian, gradient = ca.hessian(w, by)
        pad = " " * indent
        k = by.numel()
        value = ca.Function(name, inputs, [w])
        all_three = ca.Function(name, inputs, [w, ca.densify(gradient), ca.densify(hessian)])
        outputs = ["value", "g{0}", "h{0}"]
        return (
            "\n".join(pad + s for s in statements(value, slots, ["value"])),
            "\n".join(
                pad + s
                for s in [
                    *statements(all_three, slots, outputs),
                    "total += value",
                    *(f"gradient[{i}] += g{i}" for i in range(k)),
                    *(f"hessian[{i}, {j}] += h{i * k + j}" for i in range(k) for j in range(k)),
                ]
            ),
        )

    smooth_value, smooth_derivatives = code("smooth", smooth_inputs, smooth_slots, smooth, x, 4)
    ball_value, ball_derivatives = code("ball", ball_inputs, ball_slots, ball, place, 12)
    loop = [
        f"    for o in range(int(q[{layout.count}])):",
        f"        k = {layout.count + 1} + o * {layout.stride}",
        "        facets = int(q[k])",
        "        if facets == 0:",
    ]
    value_loop, derivative_loop = [*loop, ball_value], [*loop, ball_derivatives]
    value_loop.append("            total += value")
    if d == 2:
        penalty = costs.facet_penalty(place, center, facet, radius, weight, steepness)
        facet_inputs = [place, center, facet, radius, weight, steepness]
        facet_slots = [positions, "q[k + 2 + {0}]", "q[best + {0}]", "q[k + 1]", *scale]
        facet_value, facet_derivatives = code(
            "facet", facet_inputs, facet_slots, penalty, place, 12
        )
        choose = [
            "        else:",
            f"            best = k + {2 + d}",
            "            gauge = -1.0",
            "            for i in range(facets):",
            f"                a = k + {2 + d} + {d} * i",
            "                g = q[a] * (x[0] - q[k + 2]) + q[a + 1] * (x[1] - q[k + 3])",
            "                if g > gauge:",
            "                    gauge, best = g, a",
        ]
        value_loop += [*choose, facet_value, "            total += value"]
        derivative_loop += [*choose, facet_derivatives]
    return "\n".join(
        [
            "\n@compiled(float64(VECTOR, VECTOR), KEY)\ndef state_cost(x, q):",
            smooth_value,
            "    total = value",
            *value_loop,
            "    return total",
            "\n@compiled(types.void(VECTOR, VECTOR, VECTOR, MATRIX), KEY)",
            "def state_cost_derivatives(x, q, gradient, hessian):",
            "    total = 0.0",
            "    gradient[:] = 0.0",
            "    hessian[:] = 0.0",
            smooth_derivatives,
            *derivative_loop,
            "",
        ]
    )
