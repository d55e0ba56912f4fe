"""Perturbed closed loops: each disturbance does what it says, and none does nothing."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from ocp.eikonal import solve_eikonal
from ocp.pontryagin import exact_trajectory
from ocp.query import Goal, Query
from ocp.query_family import paper_query, sample_start
from ocp.value import Policy
from sims.closed_loop import LoopSettings, rollouts
from sims.disturbance import Disturbance

QUERY = paper_query((1.0, 4.0))
POINT = Query("single-integrator-2d", Goal((4.9, 4.9), 0.05))
ORIGIN = np.array([-4.0, -4.0])
WHEELS = ((0.5, 0.5), (-2.5, 2.5))  # a differential drive with a track of 0.4 m
EVERYTHING = Disturbance(
    gain=0.1, slip=0.2, wheels=WHEELS, process=(0.02, 0.02, 0.03), measurement=(0.03, 0.03, 0.03),
    delay=2, limit=0.8,
)  # fmt: skip


@pytest.fixture(scope="module")
def policy() -> Policy:
    return solve_eikonal(QUERY, nodes=9_000).policy()


@pytest.fixture(scope="module")
def starts() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [sample_start(QUERY, rng) for _ in range(6)]


@dataclass(frozen=True)
class Spy:
    """A policy that holds one input, or the clock's, and notes what it was shown."""

    query: Query
    held: tuple[float, ...]
    seen: list[np.ndarray] = field(default_factory=list)

    def __call__(self, states):
        self.seen.append(np.array(states))
        return np.broadcast_to(self.held, (*np.shape(states)[:-1], len(self.held)))


def drive(held: tuple[float, ...], disturbance: Disturbance, count: int = 1, seconds: float = 2.0):
    """Point robots from `ORIGIN` under one input, which misses the goal."""
    settings = LoopSettings(period=0.1, time_limit=seconds)
    spy = Spy(POINT, held)
    loops = rollouts(spy, [ORIGIN] * count, settings, disturbance, seed=5)
    return spy, loops


def assert_same(loops, others) -> None:
    for a, b in zip(loops, others, strict=True):
        for name in ("times", "states", "inputs", "cost_so_far"):
            np.testing.assert_array_equal(getattr(a.trajectory, name), getattr(b.trajectory, name))
        assert a.reached == b.reached


def test_no_disturbance_is_the_plain_closed_loop_to_the_last_bit(policy, starts) -> None:
    for none in (Disturbance(), Disturbance(process=(0.0,) * 3, measurement=(0.0,) * 3)):
        assert_same(rollouts(policy, starts, None, none, seed=9), rollouts(policy, starts))


def test_a_seed_is_a_trial_and_another_seed_another(policy, starts) -> None:
    once, again, other = (rollouts(policy, starts, None, EVERYTHING, s) for s in (1, 1, 2))
    assert_same(once, again)
    assert all(a.cost != b.cost for a, b in zip(once, other, strict=True))


def test_a_loop_does_not_depend_on_its_company(policy, starts) -> None:
    """The first of a batch, alone, meets the same noise, however long the others drive on."""
    together = rollouts(policy, starts, None, EVERYTHING, 3)
    assert_same(rollouts(policy, starts[:1], None, EVERYTHING, 3), together[:1])


@pytest.mark.parametrize("delay", [1, 2, 5])
def test_a_delay_shifts_the_inputs_by_whole_periods(policy, starts, delay: int) -> None:
    """The robot has no drift and stands still until the first input comes: then it does what an
    observer of old states does. A policy that holds its input moves as before, later."""
    _, (late,) = drive((0.3, -0.2), Disturbance(delay=delay))
    _, (prompt,) = drive((0.3, -0.2), Disturbance())
    shift = 4 * delay  # substeps
    np.testing.assert_array_equal(late.trajectory.inputs[:shift], 0.0)
    kept = len(prompt.trajectory.times) - shift
    assert late.trajectory.states[shift:] == pytest.approx(prompt.trajectory.states[:kept])
    loop = rollouts(policy, starts[:1], None, Disturbance(delay=delay))[0].trajectory
    samples, held = loop.states[:-1:4], loop.inputs[:-1:4]
    np.testing.assert_array_equal(held[:delay], 0.0)
    np.testing.assert_array_equal(held[delay:], policy(samples[: len(held) - delay]))


def test_inputs_saturate() -> None:
    _, (loop,) = drive((3.0, -0.2), Disturbance(limit=0.5))
    np.testing.assert_array_equal(
        loop.trajectory.inputs, [[0.5, -0.2]] * len(loop.trajectory.times)
    )
    assert loop.trajectory.states[-1] - ORIGIN == pytest.approx([1.0, -0.4])


def test_a_gain_is_constant_in_a_trial_and_within_its_share() -> None:
    _, loops = drive((0.4, -0.2), Disturbance(gain=0.1), count=200)
    ratios = np.array([loop.trajectory.inputs / [0.4, -0.2] for loop in loops])
    assert np.ptp(ratios, axis=1) == pytest.approx(0.0, abs=1e-15)
    assert ratios.min() >= 0.9
    assert ratios.max() <= 1.1
    assert np.quantile(ratios[:, 0], [0.1, 0.9]) == pytest.approx([0.92, 1.08], abs=0.01)


def test_slip_takes_speed_from_each_wheel() -> None:
    """Wheel speeds are (v - 0.2 w, v + 0.2 w); each keeps 80 to 100 %, 90 % on average."""
    _, loops = drive((0.4, 1.0), Disturbance(slip=0.2, wheels=WHEELS), count=100, seconds=10.0)
    inputs = np.concatenate([loop.trajectory.inputs for loop in loops])
    speeds = inputs @ np.linalg.inv(WHEELS).T
    share = speeds / [0.4 - 0.2, 0.4 + 0.2]
    assert share.min() >= 0.8 - 1e-12
    assert share.max() <= 1.0 + 1e-12
    # 100 loops of some 10 independent values with standard deviation 0.2 / sqrt(12) = 0.058
    assert share.mean(axis=0) == pytest.approx([0.9, 0.9], abs=4 * 0.058 / np.sqrt(1000))


def test_measurement_noise_is_seen_and_not_felt() -> None:
    spy, loops = drive((0.4, 0.0), Disturbance(measurement=(0.2, 0.0)), count=400)
    truth = np.array([loop.trajectory.states[:-1:4] for loop in loops]).swapaxes(0, 1)
    errors = np.array(spy.seen) - truth
    assert errors[..., 1] == pytest.approx(0.0, abs=1e-15)
    assert errors[..., 0].std() == pytest.approx(0.2, rel=4 / np.sqrt(2 * errors[..., 0].size))
    (plain,) = drive((0.4, 0.0), Disturbance())[1]
    np.testing.assert_array_equal(loops[7].trajectory.states, plain.trajectory.states)


def test_process_noise_grows_with_the_root_of_time_whatever_the_period() -> None:
    """After 2 s of 0.1 m / sqrt(s): the last of 20 pushes comes after the end."""
    for period in (0.1, 0.02):
        settings = LoopSettings(period=period, time_limit=2.0)
        noise = Disturbance(process=(0.1, 0.0))
        loops = rollouts(Spy(POINT, (0.0, 0.0)), [ORIGIN] * 500, settings, noise, seed=1)
        ends = np.array([loop.trajectory.states[-1] - ORIGIN for loop in loops])
        expected = 0.1 * np.sqrt(2.0 - period)
        assert ends[:, 0].std() == pytest.approx(expected, rel=4 / np.sqrt(1000))
        assert ends[:, 1] == pytest.approx(0.0, abs=1e-15)


def test_whatever_is_wrong_with_the_inputs_no_motion_beats_the_optimum(policy, starts) -> None:
    """Without process noise the motion is one of the robot's own. The loop ends 1 mm early, which
    is worth some 1e-4 of cost."""
    errors = Disturbance(gain=0.1, slip=0.2, wheels=WHEELS, delay=3, limit=0.8)
    for start, loop in zip(starts, rollouts(policy, starts, None, errors, 4), strict=True):
        assert loop.cost is not None
        assert loop.cost > exact_trajectory(QUERY, start).cost - 1e-3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gain": 1.5}, "gain"),
        ({"slip": -0.1}, "slip"),
        ({"delay": -1}, "delay"),
        ({"limit": 0.0}, "limit"),
        ({"process": (-1.0, 0.0)}, "process"),
        ({"measurement": (np.nan, 0.0)}, "measurement"),
        ({"process": (0.1,) * 5}, "process: needs 2"),
        ({"wheels": ((1.0, 1.0), (1.0, 1.0))}, "wheels"),
    ],
)
def test_what_makes_no_sense_is_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        drive((0.1, 0.1), Disturbance(**wrong))
