"""System files: the shipped ones are sound, bad ones are refused by name."""

import numpy as np
import pytest

from sims.regulation.system_file import SystemFile, shipped_systems

NAMES = list(shipped_systems())

GOOD = """
A = [[0.0, 1.0], [0.0, 0.0]]
B = [[0], [1]]
M = [[10, 0], [0, 10]]
R = [[2]]
terminal = [[0.5, 0], [0, 0.5]]
horizon = 5
start = [1, 0]
"""


def test_every_promised_system_is_shipped():
    promised = {"rover", "springless-rover", "unstable", "cart-pole", "planar-quadrotor"}
    promised |= {f"double-integrator-{d}d" for d in (1, 2, 3)} | {"random-10"}
    assert promised <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_systems_load_and_their_behaviour_is_stable(name):
    system = SystemFile.load(shipped_systems()[name])
    closed = system.problem.A - system.problem.B @ system.behaviour_gain
    # The rovers and integrators rest anywhere when let go; nothing may grow.
    assert np.linalg.eigvals(closed).real.max() <= 1e-9
    assert system.start.any()


def test_the_shipped_rover_is_the_one_of_the_models():
    from ocp.models import get_model
    from ocp.riccati import linear_dynamics

    for name in ("rover", "springless-rover", "double-integrator-3d"):
        system = SystemFile.load(shipped_systems()[name])
        A, B = linear_dynamics(get_model(name))
        assert np.array_equal(system.problem.A, A)
        assert np.array_equal(system.problem.B, B)


def test_defaults(tmp_path):
    path = tmp_path / "system.toml"
    path.write_text(GOOD)
    system = SystemFile.load(path)
    assert (system.sample_period, system.data_seconds, system.noise) == (0.01, 2.0, 0.0)
    assert system.behaviour_gain.shape == (1, 2)
    assert not system.behaviour_gain.any()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("horizon = 5", "horizon = 0", "^horizon: must be a positive"),
        ("horizon = 5", "horizon = nan", "^horizon: must be a number"),
        ("horizon = 5", "horizon = true", "^horizon: must be a number"),
        ("horizon = 5\n", "", "^horizon: missing"),
        ("R = [[2]]", "R = [[-2]]", "^R: must be positive definite"),
        ("R = [[2]]", "R = [[1, 0], [0, 1]]", "^R: must have shape"),
        ("B = [[0], [1]]", "B = [[0, 1]]", "^B: must have shape"),
        ("B = [[0], [1]]", "B = [[1], [0]]", "^A, B: not controllable.*eigenvalue 0"),
        ("B = [[0], [1]]", "B = [[0], [1, 2]]", "^B: rows must be of equal length"),
        ("B = [[0], [1]]", "B = [0, 1]", "^B: must be a list of numbers"),
        ("[0.0, 0.0]]", "[0.0, nan]]", "^A: must be a number, got nan"),
        ("M = [[10, 0], [0, 10]]", "M = [[10, 1], [0, 10]]", "^M: must be symmetric"),
        ("terminal = [[0.5, 0], [0, 0.5]]", "terminal = [[-1, 0], [0, 1]]", "^terminal: must be"),
        ("start = [1, 0]", "start = [1]", "^start: must be 2 finite numbers"),
        ("start = [1, 0]", "start = [1, 0]\nnoise = -1", "^noise: must be non-negative"),
        ("start = [1, 0]", "start = [1, 0]\nsample_period = 0", "^sample_period"),
        ("start = [1, 0]", "start = [1, 0]\ndata_seconds = 0.001", "^data_seconds: must be at"),
        ("start = [1, 0]", "start = [1, 0]\nprobing = inf", "^probing: must be non-negative"),
        ("start = [1, 0]", "start = [1, 0]\nbehaviour_gain = [[1]]", "^behaviour_gain: must be"),
        ("start = [1, 0]", "start = [1, 0]\ncolour = 1", "^colour: unknown; known are A, B"),
        ("start = [1, 0]", "start = [1, 0", "not a TOML file"),
    ],
)
def test_bad_files_are_named(tmp_path, old, new, message):
    path = tmp_path / "system.toml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ValueError, match=message):
        SystemFile.load(path)
