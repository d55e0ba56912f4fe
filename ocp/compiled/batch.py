"""A robot's compiled kernels over whole arrays of states: one call, no Python per state."""

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.function_address import ADDRESSES, address, function_at
from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled
from ocp.kernels import kernels, parameters
from ocp.query import Query

kernel_at, scalar_at = function_at(KERNEL), function_at(SCALAR)


@compiled(types.void(ADDRESSES, MATRIX, VECTOR, MATRIX))
def _rows(where, inputs, parameter, out):
    kernel = kernel_at(where[0, 0], where[0, 1])
    for i in range(inputs.shape[0]):
        kernel(inputs[i], parameter, out[i])


@compiled(types.void(ADDRESSES, MATRIX, MATRIX, MATRIX))
def _paired_rows(where, first, second, out):
    kernel = kernel_at(where[0, 0], where[0, 1])
    for i in range(first.shape[0]):
        kernel(first[i], second[i], out[i])


@compiled(types.void(ADDRESSES, MATRIX, VECTOR, VECTOR))
def _scalars(where, inputs, parameter, out):
    kernel = scalar_at(where[0, 0], where[0, 1])
    for i in range(inputs.shape[0]):
        out[i] = kernel(inputs[i], parameter)


def state_costs(query: Query, states: ArrayLike) -> NDArray[np.float64]:
    """W(x) `[...]` at states `[..., n]`."""
    rows, shape = _flat(states, query.system.n)
    out = np.empty(len(rows))
    _scalars(address(kernels(query).state_cost), rows, parameters(query), out)
    return out.reshape(shape)


def running_costs(query: Query, states: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
    """L(x, u) `[...]` at states `[..., n]` and inputs `[..., m]`."""
    rows, shape = _flat(_joined(states, inputs), query.system.n + query.system.m)
    out = np.empty(len(rows))
    _scalars(address(kernels(query).running_cost), rows, parameters(query), out)
    return out.reshape(shape)


def rates(query: Query, states: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
    """x' `[..., n]` at states `[..., n]` and inputs `[..., m]`."""
    rows, shape = _flat(states, query.system.n)
    out = np.empty_like(rows)
    where = address(kernels(query).dynamics)
    _paired_rows(where, rows, _flat(inputs, query.system.m)[0], out)
    return out.reshape(*shape, query.system.n)


def optimal_inputs(query: Query, states: ArrayLike, costates: ArrayLike) -> NDArray[np.float64]:
    """argmin_u H `[..., m]` at states and costates `[..., n]`."""
    n, m = query.system.n, query.system.m
    rows, shape = _flat(_joined(states, costates), 2 * n)
    out = np.empty((len(rows), m))
    _rows(address(kernels(query).optimal_input), rows, parameters(query), out)
    return out.reshape(*shape, m)


def minimised_hamiltonians(
    query: Query, states: ArrayLike, costates: ArrayLike
) -> NDArray[np.float64]:
    """min_u H `[...]` at states and costates `[..., n]`; 0 where the costate is V's gradient."""
    rows, shape = _flat(_joined(states, costates), 2 * query.system.n)
    out = np.empty(len(rows))
    _scalars(address(kernels(query).minimised_hamiltonian), rows, parameters(query), out)
    return out.reshape(shape)


def _joined(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    return np.concatenate([np.asarray(first, float), np.asarray(second, float)], axis=-1)


def _flat(array: ArrayLike, width: int) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """`[..., width]` as contiguous rows, and the shape of the leading axes."""
    array = np.asarray(array, dtype=float)
    if array.shape[-1:] != (width,):
        raise ValueError(f"expected {width} numbers on the last axis, got shape {array.shape}")
    return np.require(array.reshape(-1, width), requirements=["C", "W"]), array.shape[:-1]
