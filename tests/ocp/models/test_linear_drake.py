"""Linear and affine systems travel between Drake and the registry unchanged."""

# Drake's stubs mistype vectors.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalSubscript=false

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pydrake.systems.primitives import AffineSystem, LinearSystem

from ocp.models import get_model
from ocp.models.linear_drake import from_affine, to_affine

RNG = np.random.default_rng(0)
A, B, f0 = RNG.normal(size=(3, 3)), RNG.normal(size=(3, 2)), RNG.normal(size=3)
C, D = np.eye(3), np.zeros((3, 2))


@pytest.mark.parametrize("offset", [np.zeros(3), f0])
def test_there_and_back_is_the_identity(offset: np.ndarray) -> None:
    plant = AffineSystem(A, B, offset, C, D, np.zeros(3))
    system = from_affine(plant, "plant")
    x, u = RNG.normal(size=3), RNG.normal(size=2)
    np.testing.assert_allclose(
        np.array(system.dynamics(x, u)).ravel(), A @ x + B @ u + offset, rtol=1e-13
    )
    back = to_affine(system)
    assert isinstance(back, AffineSystem)
    assert_array_equal(back.A(), A)
    assert_array_equal(back.B(), B)
    assert_array_equal(back.f0(), offset)
    assert isinstance(back, LinearSystem) == (not offset.any())


def test_a_drake_linear_system_becomes_a_system() -> None:
    system = from_affine(LinearSystem(A, B, C, D), "plant")
    assert (system.n, system.m) == (3, 2)
    assert not np.array(system.dynamics(np.zeros(3), np.zeros(2))).any()


def test_registered_linear_robots_become_drakes() -> None:
    rover = to_affine(get_model("rover"))
    assert rover.A()[2, 0] == -0.5
    assert rover.B()[2, 0] == 0.025


def test_what_is_not_affine_or_not_continuous_is_refused() -> None:
    with pytest.raises(ValueError, match="'unicycle': is not affine"):
        to_affine(get_model("unicycle"))
    with pytest.raises(ValueError, match=r"must be continuous, its time period is 0.1 s"):
        from_affine(LinearSystem(A, B, C, D, 0.1), "plant")
    with pytest.raises(ValueError, match="needs a state and an input, has 3 and 0"):
        from_affine(LinearSystem(A, B[:, :0], C, D[:, :0]), "plant")
