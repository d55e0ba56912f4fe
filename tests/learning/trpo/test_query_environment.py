"""The Gymnasium environment: Gymnasium's own checks, the same robot and cost as everywhere else."""

from typing import Any

import numpy as np
import pytest
from references import typical_query

from ocp.compiled.batch import rates, running_costs
from ocp.query_family import PAPER_START, paper_query

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra rl")

from learning.trpo.query_environment import NAME, QueryEnvironment  # noqa: E402
from learning.trpo.robot_batch import EnvironmentSettings, RobotBatch, scaled  # noqa: E402
from ocp.query_family import PAPER_FAMILY  # noqa: E402


@pytest.mark.filterwarnings("ignore:.*infinity.*:UserWarning")
def test_it_is_registered_and_passes_gymnasiums_checker() -> None:
    from gymnasium.utils.env_checker import check_env

    environment = gymnasium.make(NAME, query=paper_query((1.0, 4.0)))
    check_env(environment.unwrapped, skip_render_check=True)


def test_the_reward_is_minus_the_cost_of_the_closed_loop() -> None:
    """Against many midpoint steps of the batch kernels, which knows nothing of the environment."""
    query = paper_query((1.0, 1.0))
    environment = QueryEnvironment(query)
    environment.reset(seed=0, options={"start": PAPER_START})
    action, total, info = np.array([0.6, 0.2], dtype=np.float32), 0.0, {}
    for _ in range(10):
        _, reward, ended, cut, info = environment.step(action)
        total -= reward
        assert not ended
        assert not cut
    assert info["cost"] == pytest.approx(total)
    u = scaled(query, action.astype(float), 1.5)
    np.testing.assert_allclose(u, [0.9, 0.3], rtol=1e-6)
    x, cost, fine = np.array(PAPER_START), 0.0, 2000
    for _ in range(fine):
        middle = x + 0.5 / fine * rates(query, x, u)
        cost += float(running_costs(query, middle, u)) / fine
        x = x + rates(query, middle, u) / fine
    np.testing.assert_allclose(environment.state, x, atol=1e-6)
    assert total == pytest.approx(cost, rel=1e-6)


def test_an_episode_ends_in_the_goal_and_is_cut_off_when_late() -> None:
    query = paper_query((4.0, 4.0))
    environment = QueryEnvironment(query, EnvironmentSettings(time_limit=1.0))
    environment.reset(seed=1, options={"start": (3.3, 4.0, 0.0)})
    ends = [environment.step(np.array([0.6, 0.0]))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (True, False)]  # 0.2 m at 0.9 m/s
    assert query.goal_distance(environment.state) <= 0
    environment.reset(options={"start": (0.0, 0.0, 0.0)})
    ends = [environment.step(np.zeros(2))[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]


def test_shaping_adds_up_to_the_distance_gained() -> None:
    query = paper_query((4.0, 4.0))
    plain, shaped = QueryEnvironment(query), QueryEnvironment(query, EnvironmentSettings(shaping=2))
    rng = np.random.default_rng(3)
    difference = 0.0
    for environment in (plain, shaped):
        environment.reset(options={"start": PAPER_START})
    for _ in range(20):
        action = rng.uniform(-1, 1, 2)
        difference += shaped.step(action)[1] - plain.step(action)[1]
    gained = query.goal_distance(PAPER_START) - query.goal_distance(shaped.state)
    assert difference == pytest.approx(2 * gained)


def test_equal_seeds_give_equal_episodes() -> None:
    first, second = QueryEnvironment(), QueryEnvironment()
    seen = [environment.reset(seed=7)[0] for environment in (first, second)]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert first.query == second.query
    np.testing.assert_array_equal(first.state, second.state)
    assert not np.array_equal(first.reset(seed=8)[0], seen[0])


def test_many_robots_do_what_each_does_alone() -> None:
    settings = EnvironmentSettings(shaping=1.0)
    together = RobotBatch(PAPER_FAMILY.sample, 5, settings, 0)
    actions = np.random.default_rng(1).uniform(-1, 1, (6, 5, 2))
    queries, starts = list(together.queries), together.states.copy()
    seen = together.observations()
    rewards = [together.step(a)[0] for a in actions]
    for k, query in enumerate(queries):
        alone = RobotBatch(lambda _rng, query=query: query, 1, settings, 0)
        alone.reset(0, query, starts[k])
        np.testing.assert_array_equal(alone.observations()[0], seen[k])
        for a, reward in zip(actions, rewards, strict=True):
            assert alone.step(a[k : k + 1])[0][0] == pytest.approx(reward[k], abs=1e-12)
        np.testing.assert_allclose(alone.states[0], together.states[k])


@pytest.mark.parametrize("model", ["single-integrator-1d", "double-integrator-3d", "unicycle"])
@pytest.mark.parametrize("bounded", [False, True])
def test_any_robot_becomes_an_environment(model: str, bounded: bool) -> None:
    query = typical_query(model, bounded)
    environment = QueryEnvironment(query)
    observation, _ = environment.reset(seed=0)
    assert environment.observation_space.contains(observation)
    for action in (-np.ones(query.system.m), np.ones(query.system.m)):
        observation, reward, *_ = environment.step(action)
        assert environment.observation_space.contains(observation)
        assert reward < 0
    if bounded:
        low, high = query.input_bounds
        np.testing.assert_allclose(scaled(query, np.full(query.system.m, -3.0), 1.5), low)
        np.testing.assert_allclose(scaled(query, np.ones(query.system.m), 1.5), high)


def test_what_does_not_fit_is_refused() -> None:
    settings: list[dict[str, Any]] = [
        {"step": 0.0},
        {"shaping": -1.0},
        {"slots": -1},
        {"limit": np.inf},
    ]
    for wrong in settings:
        with pytest.raises(ValueError, match=next(iter(wrong))):
            EnvironmentSettings(**wrong)
    with pytest.raises(ValueError, match="knows at most 1"):
        QueryEnvironment(paper_query((1.0, 4.0)), EnvironmentSettings(slots=1))
    with pytest.raises(ValueError, match="start: x = 9"):
        QueryEnvironment(paper_query((1.0, 4.0))).reset(options={"start": (9.0, 0.0, 0.0)})
