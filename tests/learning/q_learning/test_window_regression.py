"""The regression: its integrals' order, its recursion, its dropped windows."""

import numpy as np
import pytest
from plants_for_learning import exact_map, held_motion

from learning.q_learning.window_regression import WindowRegression, quadrature

A = np.array([[0.0, 1.0], [-1.0, -0.4]])
B = np.array([[0.0], [1.0]])
START = [1.0, -0.5]


def probes(count: int, seed: int = 0, m: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, m))


def solved(data: WindowRegression) -> np.ndarray:
    return np.linalg.solve(data.triangle, data.rotated[:, : data.q])


@pytest.mark.parametrize("substeps", range(1, 8))
def test_rules_integrate_polynomials_exactly_up_to_their_order(substeps):
    fine, coarse = quadrature(substeps)
    nodes = np.arange(substeps + 1.0)
    # Newton-Cotes with an even number of substeps gains one degree by symmetry.
    degree = substeps + 1 - substeps % 2
    for power in range(degree + 1):
        exact = substeps ** (power + 1) / (power + 1)
        assert fine @ nodes**power == pytest.approx(exact, rel=1e-12)
    beyond = degree + 1
    exact = substeps ** (beyond + 1) / (beyond + 1)
    assert abs(fine @ nodes**beyond - exact) > 1e-6 * exact
    assert coarse.sum() == pytest.approx(substeps)
    assert not np.allclose(fine, coarse)


@pytest.mark.parametrize("substeps", [0, 8])
def test_other_numbers_of_substeps_are_refused(substeps):
    with pytest.raises(ValueError, match="substeps"):
        quadrature(substeps)


@pytest.mark.parametrize(("substeps", "order"), [(1, 2), (2, 4), (4, 6)])
def test_the_learned_map_converges_with_the_rules_order(substeps, order):
    errors = []
    for refinement in (1, 2):
        hold = 0.4 / refinement
        data = WindowRegression(2, 1, hold / substeps, substeps, 1, 1.0)
        inputs = np.repeat(probes(40), refinement, axis=0)
        data.absorb(held_motion(A, B, START, hold / substeps, substeps, inputs), inputs)
        errors.append(np.abs(solved(data) - exact_map(A, B)).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.5)


@pytest.mark.parametrize(("window", "memory"), [(1, 1.0), (5, 1.0), (3, 0.9)])
def test_the_recursion_is_the_least_squares_fit_of_the_windows(window, memory):
    """Longhand: integrals by Simpson's rule, windows by loops, fit by lstsq."""
    period, holds = 0.05, 60
    inputs = probes(holds, m=2)
    plant = np.array([[0.1, 1.0, 0.0], [0.0, -0.3, 0.5], [0.2, 0.0, -1.0]])
    gain = np.array([[0.0, 0.3], [1.0, 0.0], [0.0, 1.0]])
    noise = 1e-2 * np.random.default_rng(1).normal(size=(2 * holds + 1, 3))
    states = held_motion(plant, gain, [1, 0, -1], period, 2, inputs) + noise
    data = WindowRegression(3, 2, period, 2, window, memory)
    for k in range(holds):  # hold by hold, as online
        data.absorb(states[2 * k : 2 * k + 3], inputs[k : k + 1])
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    rows, changes = [], []
    for first in range(holds - window + 1):
        row = np.zeros(data.p)
        for k in range(first, first + window):
            for weight, x in zip((1, 4, 1), states[2 * k : 2 * k + 3], strict=True):
                products = [x[i] * x[j] for i, j in pairs]
                cross = [inputs[k, a] * x[i] for a in range(2) for i in range(3)]
                row += weight * period / 3 * np.array(products + cross)
        before, after = states[2 * first], states[2 * (first + window)]
        rows.append(row)
        changes.append([after[i] * after[j] - before[i] * before[j] for i, j in pairs])
    weights = np.sqrt(memory ** np.arange(len(rows))[::-1])[:, None]
    fit, squares, _, _ = np.linalg.lstsq(
        weights * np.array(rows), weights * np.array(changes), rcond=None
    )
    assert data.rows == len(rows)
    assert data.effective_rows == pytest.approx((weights**2).sum())
    assert solved(data) == pytest.approx(fit, rel=1e-8, abs=1e-9 * np.abs(fit).max())
    assert np.diag(data.residual) == pytest.approx(squares, rel=1e-8)


def test_windows_across_a_jump_are_dropped():
    inputs = probes(30)
    first = held_motion(A, B, START, 0.05, 4, inputs[:15])
    second = held_motion(A, B, [7.0, 3.0], 0.05, 4, inputs[15:])
    told, untold = (WindowRegression(2, 1, 0.05, 4, 3, 1.0) for _ in range(2))
    for data in (told, untold):
        data.absorb(first, inputs[:15])
        if data is told:
            data.interrupt()
        data.absorb(second, inputs[15:])
    assert told.rows == 2 * (15 - 3 + 1)
    assert solved(told) == pytest.approx(exact_map(A, B), abs=1e-6)
    assert np.abs(solved(untold) - exact_map(A, B)).max() > 0.1


def test_bad_data_are_refused():
    data = WindowRegression(2, 1, 0.01, 2, 1, 1.0)
    with pytest.raises(ValueError, match="inputs: must have shape"):
        data.absorb(np.zeros((3, 2)), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="samples: must have shape"):
        data.absorb(np.zeros((4, 2)), np.zeros((1, 1)))
    with pytest.raises(ValueError, match="finite"):
        data.absorb(np.full((3, 2), np.nan), np.zeros((1, 1)))
    assert data.rows == 0
