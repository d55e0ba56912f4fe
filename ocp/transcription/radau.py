"""Legendre-Gauss-Radau collocation: the rule, and motions that are polynomials on intervals.

On each of k intervals the state is a polynomial of degree d through the interval's start and d
points, the last of which is the interval's end; the dynamics hold at those d points, where the
inputs live. States at interval ends and costs converge with order 2d - 1.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.compiled.batch import running_costs
from ocp.extremals.replay import PiecewiseInput
from ocp.query import Query
from ocp.trajectory import Trajectory

Array = NDArray[np.float64]


class Radau:
    """Points and matrices of degree `d` on [0, 1].

    Attributes:
        points: `[d]`, increasing, the last 1.
        nodes: `[d + 1]`, 0 and the points.
        to_coefficients: `[d + 1, d + 1]`, from values at the nodes to ascending coefficients.
        derivative: `[d, d + 1]`, from values at the nodes to slopes at the points.
        between: `[d, d + 1]`, from values at the nodes to values midway between neighbours.
        integral: `[d, d]`, from values at the points to integrals from 0 to each point.
        weights: `[d]`, quadrature over [0, 1].
        powers: `[d, d]`, from values at the points to ascending coefficients.
    """

    def __init__(self, degree: int) -> None:
        self.points = np.array(ca.collocation_points(degree, "radau"))
        self.nodes = np.concatenate([[0.0], self.points])
        exponents = np.arange(degree + 1)
        self.to_coefficients = np.linalg.inv(self.nodes[:, None] ** exponents)
        lowered = self.points[:, None] ** np.maximum(exponents - 1, 0)
        self.derivative = (exponents * lowered) @ self.to_coefficients
        middles = (self.nodes[1:] + self.nodes[:-1]) / 2
        self.between = middles[:, None] ** exponents @ self.to_coefficients
        self.powers = np.linalg.inv(self.points[:, None] ** exponents[:-1])
        self.integral = self.points[:, None] ** exponents[1:] / exponents[1:] @ self.powers
        self.weights = self.integral[-1]


@lru_cache
def radau(degree: int) -> Radau:
    """The rule of a degree, made once."""
    return Radau(degree)


@dataclass(frozen=True, eq=False)
class CollocatedMotion:
    """A motion on `k` intervals with `d` Radau points each.

    Attributes:
        query: gives the running cost.
        terminal: P_T `[n, n]` of the terminal cost, or `None`.
        starts: `[k, n]`, states at the intervals' starts.
        states: `[k, d, n]`, at the points.
        inputs: `[k, d, m]`, at the points.
        durations: `[k]`, of the intervals, seconds.
        start_costates: `[k, n]`, at the intervals' starts.
        costates: `[k, d, n]`, at the points.
        final_costate: `[n]`.
    """

    query: Query
    terminal: Array | None
    starts: Array
    states: Array
    inputs: Array
    durations: Array
    start_costates: Array
    costates: Array
    final_costate: Array

    @property
    def rule(self) -> Radau:
        return radau(self.states.shape[1])

    @property
    def start(self) -> Array:
        return self.starts[0]

    @property
    def cost(self) -> float:
        """The running cost."""
        return float(self.costs.sum())

    @property
    def duration(self) -> float:
        return float(self.durations.sum())

    @property
    def mesh(self) -> Array:
        """`[k + 1]` fractions of the duration at the intervals' ends."""
        return np.concatenate([[0.0], np.cumsum(self.durations) / self.duration])

    @cached_property
    def cost_rates(self) -> Array:
        """`[k, d]`, the running cost at the points."""
        return running_costs(self.query, self.states, self.inputs)

    @cached_property
    def costs(self) -> Array:
        """`[k]`, the running cost of each interval by the rule's quadrature."""
        return self.durations * (self.cost_rates @ self.rule.weights)

    @cached_property
    def total_cost(self) -> float:
        """Running plus terminal cost."""
        total = self.cost
        if self.terminal is not None:
            total += self.query.terminal_cost(self.states[-1, -1], self.terminal)
        return total

    def at(self, fractions: Array) -> tuple[Array, Array, Array]:
        """States, inputs and costates `[..., n or m]` at fractions `[...]` of the duration.

        Just after an interval's end where a fraction is one.
        """
        mesh = self.mesh
        interval = np.clip(np.searchsorted(mesh, fractions, "right") - 1, 0, len(mesh) - 2)
        within = (fractions - mesh[interval]) / np.diff(mesh)[interval]
        rule = self.rule
        whole = np.concatenate([self.starts[:, None], self.states], axis=1)
        exponents = np.arange(len(rule.nodes))
        basis = within[..., None] ** exponents
        return (
            np.einsum("...i,ij,...jn->...n", basis, rule.to_coefficients, whole[interval]),
            np.einsum("...i,ij,...jn->...n", basis[..., :-1], rule.powers, self.inputs[interval]),
            np.einsum("...i,ij,...jn->...n", basis[..., :-1], rule.powers, self.costates[interval]),
        )

    @cached_property
    def piecewise_input(self) -> PiecewiseInput:
        """The input polynomials."""
        coefficients = np.einsum("ij,kjm->kim", self.rule.powers, self.inputs)
        return PiecewiseInput(self.durations, coefficients)

    def trajectory(self) -> Trajectory:
        """The motion at its start and every point.

        The first input is the first interval's polynomial at its start, within the bounds.
        """
        n, m = self.query.system.n, self.query.system.m
        ends = np.cumsum(self.durations)
        times = (ends - self.durations)[:, None] + self.durations[:, None] * self.rule.points
        before = np.cumsum(self.costs) - self.costs
        within = self.durations[:, None] * (self.cost_rates @ self.rule.integral.T)
        # At interval ends the costates of the following start are of higher order.
        costates = self.costates.copy()
        costates[:-1, -1] = self.start_costates[1:]
        costates[-1, -1] = self.final_costate
        first = np.clip(self.piecewise_input.coefficients[0, :1], *self.query.input_bounds)
        return Trajectory(
            np.concatenate([[0.0], times.ravel()]),
            np.concatenate([self.starts[:1], self.states.reshape(-1, n)]),
            np.concatenate([first, self.inputs.reshape(-1, m)]),
            np.concatenate([self.start_costates[:1], costates.reshape(-1, n)]),
            np.concatenate([[0.0], (before[:, None] + within).ravel()]),
        )
