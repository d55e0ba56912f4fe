"""The main method: a planner's laws, deadlines, and what the shipped weights promise."""

import time
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from learning import MetaPlanner
from learning.adaptation import motions, schedule
from learning.adaptation.motions import solved_grid
from learning.adaptation.schedule import Clock, Step
from learning.adaptation.state import DOUBT
from learning.conditioned.pretrained_weights import MOST_BYTES, load_pretrained
from learning.shipped import PRETRAINED
from ocp import (
    Goal,
    Obstacle,
    Query,
    SolveError,
    deadline,
    exact_trajectory,
    iterations,
    trajectories,
)
from ocp.family_file import load_family, with_obstacle_count
from ocp.query_family import PAPER_FAMILY, PAPER_START, paper_query, sample_start
from ocp.query_file import read_toml
from sims.closed_loop import LoopSettings, rollouts

FAMILIES = ("paper", "general")
LOOP = LoopSettings(time_limit=40.0)


def aggregate_excess(policy, starts, optima):
    """Closed-loop costs over optimal ones, minus 1; infinite if a loop does not end."""
    loops = rollouts(policy, starts, LOOP)
    costs = [np.inf if r.cost is None else r.cost for r in loops]
    return float(np.sum(costs) / np.sum(optima) - 1)


@pytest.fixture(scope="module", params=FAMILIES)
def problem(request):
    """A query with an obstacle or more, four starts and their optimal costs."""
    rng = np.random.default_rng(2_000_000)
    family = load_family(request.param)
    query = family.sample(rng)
    while not query.obstacles:
        query = family.sample(rng)
    starts = [sample_start(query, rng) for _ in range(4)]
    return request.param, query, starts, [exact_trajectory(query, x).cost for x in starts]


def test_the_network_alone_is_near_the_optimum(problem):
    name, query, starts, optima = problem
    planned = MetaPlanner.pretrained(name, grids=False).plan(query, starts, iterations(0))
    assert planned.trajectories == 0
    # Held input costs some 1e-5; nothing is below the optimum.
    assert -1e-4 < aggregate_excess(planned.policy, starts, optima) < 0.05


@pytest.mark.parametrize("name", FAMILIES)
def test_the_network_alone_drives_the_last_centimetres(name):
    """Facing the goal 3 cm off, a robot needs .2 s; no state of the training is so near."""
    rng = np.random.default_rng(2_000_001)
    family, planner = load_family(name), MetaPlanner.pretrained(name, grids=False)
    for query in (family.sample(rng) for _ in range(20)):
        bearing = rng.uniform(-np.pi, np.pi, 5)
        gap = query.goal.radius + rng.uniform(0.005, 0.03, 5)
        ray = np.column_stack([np.cos(bearing), np.sin(bearing)])
        heading = bearing + np.pi * rng.integers(0, 2, 5)
        states = np.column_stack([query.reference[:2] + gap[:, None] * ray, heading])
        starts = [x for x in states if np.abs(x[:2]).max() < 5]
        policy = planner.plan(query, starts, iterations(0)).policy
        loops = rollouts(policy, starts, LoopSettings(time_limit=2.0))
        assert all(loop.reached for loop in loops), query


@pytest.mark.parametrize("name", FAMILIES)
def test_the_check_of_the_networks_loops_tells_who_arrives(name):
    rng = np.random.default_rng(2_000_002)
    family, planner = load_family(name), MetaPlanner.pretrained(name, grids=False)
    for query, start in [family.sample_with_start(rng) for _ in range(20)]:
        state = planner.start(query, [start])
        (driven,) = rollouts(planner.policy(state), [start], LOOP)
        assert driven.reached == (state.loops[0] is not None), (query, start)


def test_the_check_sees_a_trap_and_a_grid_answers():
    """Among more obstacles than the network was trained with, the robot shuttles for ever."""
    table = read_toml(Path(str(resources.files("ocp.families") / "general.toml")))
    rng = np.random.default_rng([77, 4])
    query = with_obstacle_count(table, 7, 10).sample(rng)
    start = [sample_start(query, rng) for _ in range(16)][-1]
    alone = MetaPlanner.pretrained("general", grids=False)
    state = alone.start(query, [start])
    assert state.loops == (None,)
    assert not rollouts(alone.policy(state), [start], LOOP)[0].reached
    planned = MetaPlanner.pretrained("general").plan(query, [start], iterations(0))
    assert rollouts(planned.policy, [start], LOOP)[0].reached


def test_exact_trajectories_from_the_starts_asked_for_close_the_gap(problem):
    name, query, starts, optima = problem
    planned = MetaPlanner.pretrained(name).plan(query, starts, trajectories(8))
    assert 4 <= planned.trajectories <= 8
    assert -1e-4 < aggregate_excess(planned.policy, starts, optima) < 1e-3
    for start, optimum in zip(starts, optima, strict=True):
        assert float(planned.value.value(start)) == pytest.approx(optimum, rel=1e-3)


def test_refinement_never_makes_the_answer_worse_and_keeps_its_argument(problem):
    name, query, starts, optima = problem
    planner = MetaPlanner.pretrained(name)
    state = planner.start(query, starts)
    before, pending = planner.policy(state), state.pending
    worst = aggregate_excess(before, starts, optima)
    while not state.finished and max(step.nodes for step in state.pending) < 100_000:
        state_before, state = state, planner.refine(state)
        assert state_before.tubes is not state.tubes or state.tubes is None
    assert planner.policy(planner.start(query, starts)) is not before
    assert pending == planner.start(query, starts).pending
    assert aggregate_excess(planner.policy(state), starts, optima) < worst + 1e-4


@pytest.mark.parametrize("cores", [1, 2])
def test_starts_that_a_grid_knows_better_motions_from_come_first(problem, cores):
    """And the network's own loop stays a guess beside the grid's: the grid may be wrong."""
    name, query, starts, optima = problem
    planner = replace(MetaPlanner.pretrained(name), cores=cores)
    state = planner.start(query, starts)
    dear = {1: 1.3, 3: 1.5}
    loops = tuple(
        replace(loop, cost=dear.get(i, 0.9) * optimum)
        for i, (loop, optimum) in enumerate(zip(state.loops, optima, strict=True))
        if loop is not None
    )
    state = planner.refine(replace(state, loops=loops))
    assert state.suspects == set(dear)
    assert [step.start for step in state.pending[:2]] == [3, 1]
    assert state.loops == loops
    state = planner.refine(state)
    assert state.suspects == {1}
    extremal = state.extremals[3]
    assert extremal is not None
    assert extremal.cost == pytest.approx(optima[3], rel=1e-4)


def test_a_search_that_failed_is_made_again_from_the_next_grids_loop(problem):
    """And not from the network's loop, which led nowhere."""
    name, query, starts, optima = problem
    planner = MetaPlanner.pretrained(name)
    state = planner.start(query, starts)
    state = planner.refine(replace(state, tried=frozenset({2}), pending=state.pending[:1]))
    assert 2 in state.suspects
    assert state.search(2).loop is None
    while not state.finished:
        state = planner.refine(state)
    extremal = state.extremals[2]
    assert extremal is not None
    assert extremal.cost == pytest.approx(optima[2], rel=1e-4)


def test_a_grid_becomes_the_base_only_if_its_own_loops_are_better(problem):
    name, query, starts, _ = problem
    planner = MetaPlanner.pretrained(name)
    state = planner.start(query, starts)
    for factor, better in ((0.5, False), (2.0, True)):
        network = replace(state.base, costs=factor * state.base.costs)
        refined = planner.refine(replace(state, bases=(network,)))
        assert (refined.base is not network) == better
        assert len(refined.bases) == 2


def test_a_grid_whose_loops_do_not_arrive_changes_nothing(problem):
    name, query, starts, _ = problem
    planner = MetaPlanner.pretrained(name)
    state = planner.start(query, starts)
    answer = replace(solved_grid(query, np.array(starts), 4_500), motions=(None,) * len(starts))
    for posed in (state, replace(state, loops=(None,) * len(starts))):
        refined = posed.with_grid(answer, 4_500, planner.suspicion)
        assert refined.suspects == set()
        assert refined.base is posed.base
        assert refined.pending == posed.pending


def test_of_bases_about_as_good_the_finest_steers(problem):
    """Rough loops tell a per mille of cost no better than that: the finest is believed."""
    name, query, starts, _ = problem
    state = MetaPlanner.pretrained(name).start(query, starts)
    network = state.base
    for factor, better in ((0.999, False), (0.99, True)):
        grid = replace(network, costs=factor * network.costs, nodes=network.nodes // 2)
        for bases in ((network, grid), (grid, network)):
            assert (replace(state, bases=bases).base is grid) == better
    lost = replace(network, costs=np.array([np.inf, *network.costs[1:]]))
    coarse = replace(network, nodes=network.nodes // 2)
    assert replace(state, bases=(lost, coarse)).base is coarse


def test_a_start_in_the_goal_needs_nothing(problem):
    name, query, starts, _ = problem
    inside = query.reference + 0.1 * query.goal.radius * np.eye(query.system.n)[0]
    planner = MetaPlanner.pretrained(name)
    state = planner.start(query, [inside, starts[0]])
    assert len(state.bases) == 1, "no grid stands in for a loop that is not needed"
    while not state.finished:
        state = planner.refine(state)
    assert state.trajectories == 1
    assert state.extremals[0] is None
    assert float(planner.value(state).value(inside)) == 0.0


def test_only_a_deadline_lets_fine_grids_follow_few_trajectories():
    assert max(s.nodes for s in schedule.steps(4, schedule.FIRST, False, True)) == 18_000
    assert schedule.steps(4, schedule.FIRST, True, True)[-1] == Step(nodes=240_000)
    for asked in (0, 1, 4, 5, 20):
        for patient in (False, True):
            steps = schedule.steps(asked, schedule.FIRST, patient, not patient)
            exact = [s.start for s in steps if not s.nodes]
            assert exact == list(range(asked or schedule.TRAJECTORIES))
            grids = [s.nodes for s in steps if s.nodes]
            assert grids == sorted(grids)
            assert steps[len(exact) if patient else 0] == Step(nodes=18_000)
            alone = schedule.steps(asked, 0, patient, not patient)
            assert [s.start for s in alone] == exact


def test_a_grid_must_leave_time_for_exact_trajectories(problem):
    name, query, starts, _ = problem
    clock = Clock()
    grid = clock.expected(Step(nodes=18_000), len(starts))
    exact = clock.expected(Step(start=0))
    for seconds, first in ((1.0, True), (0.1 + grid + exact, False)):
        planner = replace(MetaPlanner.pretrained(name, seconds=seconds), cores=1, clock=clock)
        state = planner.start(query, starts)
        begun = time.perf_counter() if first else time.perf_counter() - 0.1
        grid_first = tuple(sorted(state.pending, key=lambda step: not step.nodes))
        state = planner._ordered(replace(state, begun=begun, pending=grid_first))
        assert (state.pending[0].nodes > 0) == first


@pytest.mark.parametrize("seconds", [0.02, 60.0])
def test_with_a_deadline_what_is_ready_first_is_used_first(problem, seconds):
    """Whatever the order, all that was begun in time is an exact motion or a grid's base."""
    name, query, starts, optima = problem
    planner = MetaPlanner.pretrained(name, seconds=seconds)
    planner.plan(query, starts, deadline(seconds))  # loads code
    planned = planner.plan(query, starts, deadline(seconds))
    assert planned.trajectories <= 4 + 4 * len(schedule.USUAL)
    assert -1e-4 < aggregate_excess(planned.policy, starts, optima) < 0.05
    if seconds > 1.0:  # ample on any machine
        assert planned.trajectories >= 4
        assert aggregate_excess(planned.policy, starts, optima) < 1e-3


def test_what_another_core_has_ready_at_the_deadline_is_taken_up(problem):
    name, query, starts, _ = problem
    planner = replace(MetaPlanner.pretrained(name, seconds=60.0), cores=2)
    state = planner.start(query, starts)
    while not state.grids.under_way:
        state = planner.refine(state)
    (nodes,) = state.grids.under_way
    assert state.grids.awaited(nodes, 60.0)
    settled = planner.settled(state)
    assert len(settled.bases) == len(state.bases) + 1
    assert settled.trajectories == state.trajectories, "nothing is computed"
    assert planner.settled(settled).bases == settled.bases


def test_where_a_grid_knows_a_better_way_no_tube_steers(problem):
    name, query, starts, _ = problem
    planner = MetaPlanner.pretrained(name)
    state = planner.refine(planner.start(query, starts))
    while any(e is None for e in state.extremals):
        state = planner.refine(state)
    doubted = replace(state, suspects=frozenset({1}))
    assert [i for i in range(4) if doubted.is_steered(i)] == [0, 2, 3]
    assert state.tubes is not None
    assert doubted.tubes is not None
    assert len(doubted.tubes.points) < len(state.tubes.points)
    best = min(base.costs[1] for base in doubted.bases)
    assert doubted.base.costs[1] <= DOUBT * best


def test_no_starts_mean_the_whole_space(problem):
    name, query, starts, optima = problem
    planned = MetaPlanner.pretrained(name).plan(query, until=iterations(2))
    assert aggregate_excess(planned.policy, starts, optima) < 0.05
    within = MetaPlanner.pretrained(name, seconds=60.0).plan(query, until=iterations(2))
    assert within.trajectories == 2
    assert aggregate_excess(within.policy, starts, optima) < 0.05
    assert within.value.value(np.zeros((0, 3))).shape == (0,)


def test_a_step_is_not_begun_that_would_end_late():
    """The rule sees the expected time of the next step, learned from those before."""
    clock = Clock()
    for _ in range(20):
        clock.learn(Step(start=0), 0.5)
        clock.learn(Step(nodes=18_000), 0.1)
    assert clock.expected(Step(start=0)) >= 0.45
    assert clock.expected(Step(nodes=60_000)) >= 0.25
    state = MetaPlanner.pretrained("paper").start(paper_query((1.0, 4.0)), [np.array(PAPER_START)])
    assert state.next_seconds > 0


def test_without_obstacles_the_value_is_the_closed_form():
    query = paper_query((4.0, 4.0))
    planned = MetaPlanner.shipped().plan(query, until=iterations(0))
    facing = np.array([0.5, 0.5, np.pi / 4])
    assert float(planned.value.value(facing)) == pytest.approx(
        exact_trajectory(query, facing).cost, rel=1e-4
    )


def test_each_query_gets_the_network_that_knows_it():
    paper = load_pretrained("paper")
    assert paper.knows(paper_query((1.0, 4.0)))
    other = Query("unicycle", Goal((1.0, 4.0), 0.5), (Obstacle.circle((0, 0), 1.0),))
    assert not paper.knows(other)
    assert load_pretrained("general").knows(other)
    with pytest.raises(SolveError, match="other queries"):
        MetaPlanner.pretrained("paper").plan(other)
    assert MetaPlanner.shipped().plan(other, until=iterations(0)).trajectories == 0


def test_other_robots_are_refused():
    with pytest.raises(SolveError, match="unicycle"):
        MetaPlanner.shipped().plan(Query("rover", Goal((1.0, 1.0), 0.5)))


@pytest.mark.parametrize("name", FAMILIES)
def test_shipped_weights_are_small_and_say_where_they_come_from(name):
    made = load_pretrained(name)
    assert (PRETRAINED / f"{name}.safetensors").stat().st_size <= MOST_BYTES
    for key in ("command", "data_sha256", "settings", "held_out"):
        assert key in made.provenance


def test_unknown_weights_are_refused():
    with pytest.raises(ValueError, match="'mine' is unknown"):
        MetaPlanner.pretrained("mine")


def test_how_many_cores_work_changes_the_time_alone() -> None:
    """Trajectories computed ahead on other cores are those that one core computes in turn."""
    rng = np.random.default_rng(7)
    query = PAPER_FAMILY.sample(rng)
    starts = [sample_start(query, rng) for _ in range(6)]
    answers = []
    for cores in (1, 2, 5):
        planner = replace(MetaPlanner.pretrained("paper"), cores=cores)
        answers.append(planner.plan(query, starts, trajectories(6)))
    assert answers[0].trajectories == 6
    for other in answers[1:]:
        assert other.trajectories == 6
        np.testing.assert_array_equal(other.value.value(starts), answers[0].value.value(starts))
        np.testing.assert_array_equal(other.policy(starts), answers[0].policy(starts))


@pytest.mark.parametrize("step", [Step(start=0), Step(nodes=60_000)], ids=["trajectory", "grid"])
def test_one_slow_step_does_not_end_all_others(step: Step) -> None:
    """The first one loads code, for seconds; steps that are always slow are believed."""
    clock = Clock()
    usual = clock.expected(step)
    clock.learn(step, 5.0)
    assert clock.expected(step) == usual
    for _ in range(20):
        clock.learn(step, 10 * usual)
    assert clock.expected(step) == pytest.approx(10 * usual, rel=0.05)


def test_the_first_grid_is_the_finest_that_ends_before_the_deadline() -> None:
    clock = Clock()
    sizes = [clock.first_grid(4, seconds) for seconds in np.linspace(1e-3, 0.1, 50)]
    assert sizes == sorted(sizes)
    assert sizes[0] == 0
    assert sizes[-1] == schedule.FIRST
    assert clock.first_grid(40, 0.02) < clock.first_grid(1, 0.02)


def test_within_a_deadline_a_grid_is_begun_first_only_where_a_loop_is_a_surprise(
    problem, monkeypatch
) -> None:
    """Doubted is a loop that costs more than V had said at its start."""
    name, query, starts, _ = problem
    planner = MetaPlanner.pretrained(name, seconds=60.0)
    for surprise, first in ((10.0, False), (0.5, True)):
        monkeypatch.setattr(motions, "SURPRISE", surprise)
        assert bool(replace(planner, cores=2).start(query, starts).grids.under_way) == first
        assert bool(replace(planner, cores=1).start(query, starts).pending[0].nodes) == first


def test_what_was_too_slow_for_any_deadline_is_forgotten_in_time(problem) -> None:
    name, query, starts, _ = problem
    clock = Clock(trajectory=1.0, pace=100.0)
    planner = replace(MetaPlanner.pretrained(name, seconds=0.02), clock=clock)
    assert clock.first_grid(1, 0.02) == 0
    for _ in range(400):
        planner.start(query, starts)
    assert clock.first_grid(1, 0.02) > 0
    assert clock.expected(Step(start=0)) < 0.01
