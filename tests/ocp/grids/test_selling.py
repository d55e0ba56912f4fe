"""Selling's decomposition: D = sum w e e' with w >= 0 and integer e, in 1 to 3 dimensions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp.grids.selling import decompose, offset_count

angle = st.floats(-np.pi, np.pi)
eigenvalue = st.floats(-4.0, 0.0).map(lambda exponent: 10.0**exponent)


@st.composite
def metrics(draw: st.DrawFn) -> np.ndarray:
    """A symmetric positive definite matrix with eigenvalues from 1e-4 to 1, any orientation."""
    n = draw(st.sampled_from([1, 2, 3]))
    rotation = np.eye(n)
    for i in range(n):
        for j in range(i + 1, n):
            a, plane = draw(angle), np.eye(n)
            plane[[i, i, j, j], [i, j, i, j]] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
            rotation = rotation @ plane
    D = rotation @ np.diag([draw(eigenvalue) for _ in range(n)]) @ rotation.T
    return (D + D.T) / 2


@given(metrics())
def test_weights_and_offsets_sum_to_the_metric(D):
    w, e = decompose(D)
    n = len(D)
    assert w.shape == (offset_count(n),)
    assert e.shape == (offset_count(n), n)
    assert (w >= 0).all()
    assert e.dtype == np.int64
    # Rounding: scalar products of superbase vectors whose entries are up to some 100.
    assert np.allclose(np.einsum("k,ki,kj->ij", w, e, e), D, rtol=0, atol=1e-10 * abs(D).max())


@given(metrics())
def test_offsets_are_as_short_as_the_anisotropy_allows(D):
    """w_e (e . p)^2 <= p' D p for every p; with p = e, |e| <= sqrt(largest eigenvalue / w_e)."""
    w, e = decompose(D)
    squared = (e**2).sum(axis=1)
    assert (w * squared <= np.linalg.eigvalsh(D)[-1] * (1 + 1e-9)).all()


@given(metrics())
def test_the_form_is_reproduced_for_any_covector(D):
    p = np.random.default_rng(0).normal(size=(20, len(D)))
    w, e = decompose(D)
    form = ((p @ e.T) ** 2 * w).sum(axis=1)
    assert np.allclose(form, np.einsum("ki,ij,kj->k", p, D, p), rtol=1e-8, atol=1e-10 * D.max())


def test_an_isotropic_metric_needs_the_axes_only():
    for n in (1, 2, 3):
        w, e = decompose(2.0 * np.eye(n))
        used = e[w > 0]
        assert np.allclose(w[w > 0], 2.0)
        assert sorted(map(tuple, abs(used))) == sorted(map(tuple, np.eye(n, dtype=int)))


def test_many_metrics_at_once_agree_with_one_by_one():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 5, 3, 3))
    D = A @ np.swapaxes(A, -1, -2) + 0.1 * np.eye(3)
    w, e = decompose(D)
    assert w.shape == (4, 5, 6)
    assert e.shape == (4, 5, 6, 3)
    one_w, one_e = decompose(D[2, 3])
    assert np.array_equal(w[2, 3], one_w)
    assert np.array_equal(e[2, 3], one_e)


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        (np.eye(4), "n from 1 to 3"),
        (np.ones((2, 3)), "n from 1 to 3"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.diag([1.0, np.nan]), "finite"),
        (np.diag([1.0, 0.0]), "positive definite"),
        (np.diag([1.0, -1.0, 1.0]), "positive definite"),
    ],
)
def test_bad_metrics_are_refused(metric, message):
    with pytest.raises(ValueError, match=message):
        decompose(metric)
