"""The scene's distances, clearances and certificates against closed forms and searches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import clearance_by_search
from scipy.optimize import minimize

from ocp.obstacle import Obstacle
from planners.solids import Solid
from planners.world import TOLERANCE, SceneWorld

OBSTACLES = [
    Obstacle.circle([1.0, 0.5], 0.8),
    Obstacle.polygon([[-2.0, -1.0], [-0.5, -1.5], [0.0, 0.0], [-1.5, 0.5]]),
    Obstacle.diamond([0.5, 2.5], 0.7),
    Obstacle.polygon([[-3, 2], [-1, 2], [-1, 2.1], [-3, 2.1]]),
]


def scene(obstacles=tuple(OBSTACLES)) -> SceneWorld:
    return SceneWorld([-4, -4], [4, 4], obstacles)


def test_distances_are_the_closed_forms() -> None:
    points = np.random.default_rng(0).uniform(-4, 4, (300, 2))
    truth = np.array([o.signed_distance(points) for o in OBSTACLES])
    found = scene().distances(points.reshape(30, 10, 2))
    assert found.distance.shape == (30, 10)
    assert np.abs(found.distance.ravel() - truth.min(axis=0)).max() < 1e-12
    assert np.array_equal(found.handle.ravel(), truth.argmin(axis=0))


def test_gradients_are_those_of_the_distance() -> None:
    points = np.random.default_rng(1).uniform(-4, 4, (200, 2))
    world, h = scene(), 1e-6
    found = world.distances(points)
    steps = np.stack([points + h * e for e in np.eye(2)] + [points - h * e for e in np.eye(2)])
    around = world.distances(steps).distance
    difference = (around[:2] - around[2:]).T / (2 * h)
    # Away from the ridges where two obstacles or two sides are equally near.
    smooth = np.abs(np.linalg.norm(difference, axis=1) - 1) < 1e-6
    assert smooth.mean() > 0.95
    assert np.abs(found.gradient - difference)[smooth].max() < 1e-6


def test_nothing_within_reach_is_said() -> None:
    found = scene().distances([[-4.0, 4.0], [1.0, 1.5]], within=1.0)
    assert np.isinf(found.distance[0])
    assert found.handle[0] == -1
    assert found.gradient[0].tolist() == [0, 0]
    assert found.distance[1] == pytest.approx(0.2)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), scale=st.sampled_from([0.3, 1.0, 4.0]))
def test_edge_clearances_in_the_plane_are_exact(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    world = scene()
    starts = rng.uniform(-4, 4, (80, 2))
    ends = starts + scale * rng.normal(size=(80, 2))
    points = np.concatenate([starts, ends])
    edges = np.column_stack([np.arange(80), np.arange(80, 160)])
    lengths = np.linalg.norm(ends - starts, axis=1)
    for handle, obstacle in zip(world.handles, OBSTACLES, strict=True):
        truth = clearance_by_search(obstacle, starts, ends)
        found = world.edge_clearances(handle, points, edges, lengths, within=1.0)
        assert set(np.flatnonzero(truth < 1.0)) <= set(found.index)
        exact = truth[found.index]
        outside = exact > 1e-6
        assert np.abs(found.lower - exact)[outside].max(initial=0) < 1e-6
        assert np.array_equal(found.lower, found.upper)
        # Contact counts as a clearance of at most 0.
        assert (found.upper[exact < -1e-6] <= 0).all()


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000))
def test_edge_clearances_in_space_are_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    solids = [
        Solid.ball(rng.uniform(-1, 1, 3), 0.5),
        Solid.box([-1, -0.4, -0.7], [0.8, 0.4, 0.7]).moved([0, 0, 0], turn),
        Solid.hull(rng.normal(size=(9, 3))),
    ]
    world = SceneWorld([-4] * 3, [4] * 3, solids)
    starts, ends = rng.uniform(-2, 2, (2, 25, 3))
    points = np.concatenate([starts, ends])
    edges = np.column_stack([np.arange(25), np.arange(25, 50)])
    lengths = np.linalg.norm(ends - starts, axis=1)
    for handle, solid in zip(world.handles, solids, strict=True):
        found = world.edge_clearances(handle, points, edges, lengths, within=10.0)
        assert len(found.index) == 25
        for k in range(25):
            truth = hull_distance(solid, starts[k], ends[k])
            assert max(found.upper[k], 0.0) == pytest.approx(max(truth, 0.0), abs=2e-5)


def hull_distance(solid: Solid, start: np.ndarray, end: np.ndarray) -> float:
    """Distance of a segment and a solid as a quadratic programme over weights of the vertices."""
    corners = solid.vertices

    def gap(z: np.ndarray) -> np.ndarray:
        return start + z[0] * (end - start) - z[1:] @ corners

    best = min(
        (
            minimize(
                lambda z: float(gap(z) @ gap(z)),
                np.r_[t, np.full(len(corners), 1 / len(corners))],
                jac=lambda z: 2 * np.r_[gap(z) @ (end - start), -corners @ gap(z)],
                bounds=[(0, 1)] * (1 + len(corners)),
                constraints={
                    "type": "eq",
                    "fun": lambda z: z[1:].sum() - 1,
                    "jac": lambda _: np.r_[0.0, np.ones(len(corners))],
                },
                method="SLSQP",
                options={"ftol": 1e-14, "maxiter": 400},
            ).fun
            for t in (0.1, 0.9)
        ),
    )
    return float(np.sqrt(max(best, 0.0))) - solid.radius


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), padding=st.floats(0, 1))
def test_certificates_agree_with_the_clearances(seed: int, padding: float) -> None:
    rng = np.random.default_rng(seed)
    starts, ends = rng.uniform(-4, 4, (2, 60, 2))
    truth = np.min([clearance_by_search(o, starts, ends) for o in OBSTACLES], axis=0)
    free = scene().certify(starts, ends, padding)
    clear_cut = np.abs(truth - padding) > 1e-6
    assert np.array_equal(free[clear_cut], (truth > padding)[clear_cut])


def test_a_thin_wall_is_never_stepped_over() -> None:
    world = scene([Solid.box([-0.001, -3], [0.001, 3])])
    rng = np.random.default_rng(0)
    starts = np.column_stack([rng.uniform(-4, -0.1, 200), rng.uniform(-2, 2, 200)])
    ends = np.column_stack([rng.uniform(0.1, 4, 200), rng.uniform(-2, 2, 200)])
    assert not world.certify(starts, ends, 0.0).any()
    points = np.concatenate([starts, ends])
    edges = np.column_stack([np.arange(200), np.arange(200, 400)])
    lengths = np.linalg.norm(ends - starts, axis=1)
    found = world.edge_clearances(world.handles[0], points, edges, lengths, 1.0)
    assert len(found.index) == 200
    assert (found.upper <= 0).all()


def test_contact_is_blocked_and_a_hair_more_is_free() -> None:
    world = scene([Solid.ball([0, 0], 1.0)])
    start = np.array([[-3.0, 1.5]])
    assert not world.certify(start, start * [-1, 1], 0.5)[0]
    assert world.certify(start, start * [-1, 1], 0.5 - 2 * TOLERANCE)[0]


def test_obstacles_come_move_and_go() -> None:
    world = scene([])
    first, second = world.add(OBSTACLES[0]), world.add(OBSTACLES[1])
    world.move(first, [0.0, -2.0])
    assert world.handles == (first, second)
    assert world.distances([1.0, -1.5]).distance == pytest.approx(-0.8)
    world.remove(first)
    assert world.handles == (second,)
    assert world.add(OBSTACLES[0]) not in (first, second)
    with pytest.raises(ValueError, match="handle"):
        world.remove(first)
    with pytest.raises(ValueError, match="handle"):
        world.move(first, [0, 0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: w.distances([[np.nan, 0]]), "points"),
        (lambda w: w.distances([[0, 0, 0]]), "points"),
        (lambda w: w.distances([[0, 0]], within=-1), "within"),
        (lambda w: w.add(Solid.ball([0, 0, 0], 1)), "obstacle"),
        (lambda w: w.add(Obstacle("circle", (np.nan, 0.0), 1.0)), "center"),
    ],
)
def test_bad_questions_are_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(scene())


@pytest.mark.parametrize(
    ("lower", "upper"),
    [([0, 0], [0, 1]), ([0, 0], [np.inf, 1]), ([0], [1]), ([0, 0], [1, 1, 1]), ([0] * 4, [1] * 4)],
)
def test_bad_boxes_are_refused(lower: list, upper: list) -> None:
    with pytest.raises(ValueError, match=r"upper|coordinates"):
        SceneWorld(lower, upper)
