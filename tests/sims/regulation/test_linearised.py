"""The shipped robots of Drake's MultibodyPlant are still what Drake's linearisation gives."""

import numpy as np
import pytest

from sims.regulation.linearised import GRAVITY, LINEARISED
from sims.regulation.system_file import SystemFile, shipped_systems


@pytest.mark.parametrize("name", list(LINEARISED))
def test_the_shipped_file_holds_drakes_linearisation(name):
    A, B = LINEARISED[name]()
    system = SystemFile.load(shipped_systems()[name])
    assert pytest.approx(A, abs=1e-11) == system.problem.A
    assert pytest.approx(B, abs=1e-11) == system.problem.B


def test_the_cart_pole_is_the_textbooks():
    """A uniform rod of mass m, length l on a cart of mass M; J = m l^2/3 about the pivot."""
    M, m, length = 1.0, 0.2, 1.0
    inertia = np.array([[M + m, m * length / 2], [m * length / 2, m * length**2 / 3]])
    pull = np.linalg.solve(inertia, np.column_stack([[0.0, m * GRAVITY * length / 2], [1.0, 0.0]]))
    A, B = LINEARISED["cart-pole"]()
    assert A[2:, 1] == pytest.approx(pull[:, 0], rel=1e-9)
    assert B[2:, 0] == pytest.approx(pull[:, 1], rel=1e-9)
    assert np.abs(A[:, [0]]).max() < 1e-12
    assert A[:2, 2:] == pytest.approx(np.eye(2))


def test_the_quadrotor_falls_sideways_when_it_tilts():
    A, B = LINEARISED["planar-quadrotor"]()
    inertia = 1.0 / 12 * (0.5**2 + 0.05**2)
    assert A[3, 2] == pytest.approx(-GRAVITY)
    assert B[4] == pytest.approx([1.0, 1.0])
    assert B[5] == pytest.approx([0.25 / inertia, -0.25 / inertia])
