"""TRPO: settings, stored policies, and a training run that learns; the shipped policy drives."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from learning.shipped import CONFIGS
from learning.trpo.policy import TRAINED, RolloutValue, TrpoPolicy, TrpoSettings, TrpoWeights
from learning.trpo.robot_batch import EnvironmentSettings
from ocp.query_family import PAPER_FAMILY, PAPER_START, paper_query, sample_start
from sims.closed_loop import LoopSettings, rollouts

CONFIG = CONFIGS / "trpo.toml"
LOOP = LoopSettings(period=0.1)


def small_weights() -> TrpoWeights:
    rng = np.random.default_rng(0)
    settings = TrpoSettings(hidden=(8,))
    count = TrpoPolicy.encoder_of(settings).count
    shapes = ((8, count), (2, 8))
    layers = tuple((rng.normal(size=s), rng.normal(size=s[0])) for s in shapes)
    single = tuple(
        (m.astype(np.float32).astype(float), b.astype(np.float32).astype(float)) for m, b in layers
    )
    return TrpoWeights(single, settings, {"command": "a test"})


def test_the_shipped_configuration_is_the_default() -> None:
    assert TrpoSettings.load(CONFIG) == TrpoSettings()


def test_weights_survive_the_disk_bit_for_bit(tmp_path: Path) -> None:
    weights = small_weights()
    weights.save(tmp_path / "policy.safetensors")
    again = TrpoWeights.load(tmp_path / "policy.safetensors")
    assert again.settings == weights.settings
    assert again.provenance == weights.provenance
    for (a, b), (c, d) in zip(again.layers, weights.layers, strict=True):
        np.testing.assert_array_equal(a, c)
        np.testing.assert_array_equal(b, d)


def test_damaged_weights_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    small_weights().save(path)
    raw = bytearray(path.read_bytes())
    raw[-1] ^= 1
    path.write_bytes(raw)
    with pytest.raises(ValueError, match="damaged"):
        TrpoWeights.load(path)
    with pytest.raises(FileNotFoundError):
        TrpoWeights.load(tmp_path / "nowhere.safetensors")


def test_a_policy_is_vectorised_rests_in_the_goal_and_knows_its_limits() -> None:
    policy = TrpoPolicy(paper_query((4.0, 4.0)), small_weights())
    states = np.random.default_rng(1).uniform(-4, 4, (3, 2, 3))
    inputs = policy(states)
    assert inputs.shape == (3, 2, 2)
    np.testing.assert_allclose(inputs[1, 1], policy(states[1, 1]))
    assert np.abs(inputs).max() <= 1.5
    np.testing.assert_array_equal(policy([4.0, 4.3, 0.0]), [0.0, 0.0])
    crowded = paper_query((1.0, 4.0))
    crowded = replace(crowded, obstacles=crowded.obstacles * 2)
    with pytest.raises(ValueError, match="knows at most 3"):
        TrpoPolicy(crowded, small_weights())


def test_the_value_is_what_the_closed_loop_costs() -> None:
    """A simple policy that drives straight at 0.9 m/s from a start that faces the goal."""

    class Straight:
        query = paper_query((4.0, 4.0))

        def __call__(self, states) -> np.ndarray:
            return np.broadcast_to([0.9, 0.0], (*np.shape(states)[:-1], 2))

    start = np.array([1.0, 1.0, np.pi / 4])
    value = RolloutValue(Straight(), EnvironmentSettings(time_limit=10.0, substeps=10))
    (loop,) = rollouts(Straight(), [start], LOOP)
    # The value stops at the end of a substep of 10 ms in the goal, at a cost below 1.81 a second.
    assert loop.cost is not None
    assert value.value(start) - loop.cost == pytest.approx(0.01, abs=0.01)
    assert value.value([*start[:2], 2.0]) == np.inf


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "meta"', "kind"),
        ('kind = "trpo"\nstep = 3', "step: unknown"),
        ('kind = "trpo"\nsteps = 0', "steps: must be at least 1"),
        ('kind = "trpo"\nsteps = "many"', "steps: must be a whole number"),
        ('kind = "trpo"\ndiscount = 1.5', "discount: must lie in"),
        ('kind = "trpo"\nhidden = []', "hidden"),
        ('kind = "trpo"\n[environment]\nstep = -1', "step: must be a positive"),
    ],
)
def test_wrong_configurations_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "trpo.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        TrpoSettings.load(path)


@pytest.mark.slow
def test_a_short_run_learns_goes_on_where_it_was_and_is_stored(tmp_path: Path) -> None:
    pytest.importorskip("sb3_contrib", reason="needs the extra rl")
    from learning.trpo.training import train

    short = TrpoSettings(
        steps=4096,
        robots=32,
        rollout=64,
        hidden=(16,),
        environment=EnvironmentSettings(shaping=2.0),
    )
    path = train(short, tmp_path)
    rows = json.loads((tmp_path / "curve.json").read_text())["rows"]
    assert rows[-1][0] == 4096
    weights = TrpoWeights.load(path)
    assert weights.provenance["last"]["steps"] == 4096
    assert train(short, tmp_path) == path  # nothing left to do
    assert json.loads((tmp_path / "curve.json").read_text())["rows"] == rows
    with pytest.raises(ValueError, match="other settings"):
        train(replace(short, seed=1), tmp_path)


@pytest.mark.skipif(not TRAINED.is_file(), reason="no trained policy is shipped")
def test_the_shipped_policy_reaches_fresh_goals() -> None:
    weights, rng = TrpoWeights.load(), np.random.default_rng(12)
    reached = []
    for _ in range(4):
        query = PAPER_FAMILY.sample(rng)
        starts = [sample_start(query, rng) for _ in range(8)]
        reached += [loop.reached for loop in rollouts(TrpoPolicy(query, weights), starts, LOOP)]
    assert np.mean(reached) >= 0.9
    loop = rollouts(TrpoPolicy(paper_query((4.0, 4.0)), weights), [PAPER_START], LOOP)[0]
    assert loop.reached
