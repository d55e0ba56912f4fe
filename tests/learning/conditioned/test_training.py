"""Training of the conditioned network: its loss, its samples, and runs that go on to the bit."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from learning.conditioned import training, training_run
from learning.conditioned.pretrained_weights import read_pretrained
from learning.conditioned.query_encoder import REACH
from learning.conditioned.training import TrainingSettings
from learning.conditioned.training_data import family_tensors
from learning.conditioned.value_function import Widths
from learning.conditioned.value_samples import (
    NEAR,
    NEAREST,
    SampleSizes,
    SampleTask,
    beside_goal,
    input_directions,
    known_values,
    sample_query,
)
from ocp.compiled.batch import minimised_hamiltonians
from ocp.eikonal import solve_eikonal
from ocp.execution import InProcess
from ocp.grid import Grid
from ocp.grids.goal_table import goal_table
from ocp.pontryagin import exact_trajectory
from ocp.query_family import paper_query
from ocp.query_file import query_from_dict

SETTINGS = TrainingSettings(
    "paper",
    SampleSizes(queries=5, states=200, nodes=9_000),
    widths=Widths(8, 12, 2),
    steps=60,
    batch=64,
    warm_up=5,
    held_out=2,
    checkpoint_steps=20,
)


@pytest.fixture(scope="module")
def samples():
    tasks = [SampleTask("paper", SETTINGS.data, 0, k) for k in range(SETTINGS.data.queries)]
    return [(query_from_dict(q), s) for q, s in map(sample_query, tasks)]


@pytest.fixture(scope="module")
def tensors(samples):
    return family_tensors(samples[:-2]), family_tensors(samples[-2:])


def test_sampled_values_are_the_optimal_ones(samples):
    """A grid of 9,000 nodes is right to about 1 % (the median error of its benchmark)."""
    errors = []
    for query, known in samples[:2]:
        for x, value in zip(known.states[:8], known.values[:8], strict=True):
            if (abs(x[:2]) <= 5).all():
                errors.append(value / exact_trajectory(query, x).cost - 1)
    assert np.median(np.abs(errors)) < 0.01
    assert len(errors) >= 8


def test_square_to_the_ray_to_the_goal_values_have_no_kink_of_the_empty_worlds():
    """There V without obstacles has a kink, which V beside an obstacle has not."""
    query = paper_query((3.74, 2.17))  # three obstacles; the state lies off V's own kinks
    square = np.arctan2(2.17 + 4.49, 3.74 - 2.19) - np.pi / 2
    headings = square + np.linspace(-0.15, 0.15, 7)
    states = np.array([(2.19, -4.49, h) for h in headings])
    table = goal_table(query, REACH)
    grid = solve_eikonal(query, Grid.for_query(query, 240_000, margin=0.5)).value.on_grid
    known = known_values(query, table, grid, states)
    optima = [exact_trajectory(query, x) for x in states]
    smooth = known.smooth
    assert smooth[3:].all(), "from the kink of the empty world on"
    # That kink, 4 a radian, would raise V between two nodes 0.12 rad apart by up to 0.06.
    costs = np.array([o.cost for o in optima])
    assert known.values[smooth] == pytest.approx(costs[smooth], abs=0.012)
    first = [o.costates[0] for o in optima if o.costates is not None]
    slopes = np.einsum("kn,knm->km", first, input_directions(query, states))
    cosine = (slopes * known.slopes).sum(axis=1) / np.linalg.norm(slopes, axis=1)
    cosine /= np.linalg.norm(known.slopes, axis=1)
    assert (cosine[smooth] > 0.99).all()


@pytest.mark.parametrize("goal", [(1.0, 4.0), (0.008, 0.288)], ids=["free", "beside a circle"])
def test_beside_the_goal_samples_are_exact(goal):
    """Also where an obstacle's penalty reaches into the goal, and from where headings graze it."""
    query = paper_query(goal)
    known = beside_goal(query, 200, np.random.default_rng(4))
    distance = query.goal_distance(known.states)
    assert len(distance) > 150
    assert known.smooth.all()
    assert NEAREST / 2 < distance.min() < 0.005
    assert 0.1 < distance.max() < NEAR
    facing = known.states[:, 2] - np.arctan2(*(known.states[:, :2] - query.reference[:2]).T[::-1])
    assert np.abs(np.cos(facing)).min() < 0.1
    assert np.abs(np.cos(facing)).max() > 0.95
    directions = input_directions(query, known.states)
    for x, value, slopes, d in list(
        zip(known.states, known.values, known.slopes, directions, strict=True)
    )[::12]:
        optimum = exact_trajectory(query, x)
        assert value == pytest.approx(optimum.cost, rel=2e-5, abs=1e-8)
        assert optimum.costates is not None
        assert slopes == pytest.approx(optimum.costates[0] @ d, rel=1e-3, abs=1e-4)


def test_smooth_samples_satisfy_the_hamilton_jacobi_equation(samples):
    query, known = samples[0]
    assert 0.6 < known.smooth.mean() < 1
    # grad V enters H through G' grad V only; the least-norm vector with those slopes stands in.
    directions = input_directions(query, known.states)
    gradients = np.stack(
        [
            np.linalg.lstsq(d.T, s, rcond=None)[0]
            for d, s in zip(directions, known.slopes, strict=True)
        ]
    )
    residual = minimised_hamiltonians(query, known.states, gradients)
    scale = (known.slopes**2).sum(axis=1) / 4
    relative = np.abs(residual) / np.maximum(scale, 1e-9)
    # |effort - sqrt W| < 6 % of sqrt W is 13 % of the squares.
    assert (relative[known.smooth] < 0.14).all()


def test_slopes_of_a_batch_are_derivatives_of_its_values(tensors):
    """Automatic differentiation through features, against differences along the directions."""
    known, _ = tensors
    state = training.start(SETTINGS, known)
    network = state.network.double()
    rows = np.arange(50)
    batch = known.batch(rows)
    wide = type(batch)(
        *(
            getattr(batch, n) if n == "owner" else getattr(batch, n).double()
            for n in batch.__dataclass_fields__
        )
    )
    V, slopes = training.value_and_slopes(network, wide, create_graph=False)
    h = 1e-5
    for t in range(2):
        stepped = replace(
            wide,
            free=wide.free + h * torch.cat([wide.free[:, 1 + t : 2 + t], 0 * wide.free[:, 1:]], 1),
            state=(wide.state + h * wide.state_slopes[..., t]).detach(),
            obstacle=(wide.obstacle + h * wide.obstacle_slopes[..., t]).detach(),
        )
        after, _ = training.value_and_slopes(network, stepped, create_graph=False)
        np.testing.assert_allclose(
            ((after - V) / h).detach().numpy(), slopes[:, t].detach().numpy(), atol=2e-3, rtol=2e-3
        )


def test_the_loss_counts_angles_and_relative_errors(tensors):
    """Longhand: 1 - cos of the angle, and the squared logarithm (small enough for no Huber)."""
    known, _ = tensors
    network = training.start(SETTINGS, known).network
    rows = np.arange(100)
    V, slopes = training.value_and_slopes(network, known.batch(rows), create_graph=False)
    V, slopes = V.detach().numpy(), slopes.detach().numpy()
    direction, value = training.loss_parts(network, known, rows, create_graph=False)
    wanted, smooth = known.slopes[:100].numpy(), known.smooth[:100].numpy()
    cosine = (
        (slopes * wanted).sum(1) / np.linalg.norm(slopes, axis=1) / np.linalg.norm(wanted, axis=1)
    )
    assert direction.item() == pytest.approx((1 - cosine)[smooth].mean(), abs=1e-5)
    gap = np.log(V / known.values[:100].numpy())
    huber = np.where(np.abs(gap) < 0.3, gap**2, 0.3 * (2 * np.abs(gap) - 0.3))
    assert value.item() == pytest.approx(huber.mean(), rel=1e-3)


def test_training_lowers_the_loss(tensors):
    known, held_out = tensors
    settings = replace(SETTINGS, steps=250)
    state = training.start(settings, known)
    rows = np.arange(known.size)
    before = sum(p.item() for p in training.loss_parts(state.network, known, rows))
    *_, state = training.train(settings, state, known, held_out)
    after = sum(p.item() for p in training.loss_parts(state.network, known, rows))
    assert after < 0.5 * before


def test_a_resumed_run_ends_with_the_same_weights(tensors, tmp_path):
    known, held_out = tensors
    *_, whole = training.train(SETTINGS, training.start(SETTINGS, known), known, held_out)
    path = tmp_path / "checkpoint.pt"
    stopped = training.start(SETTINGS, known)
    for stopped in training.train(SETTINGS, stopped, known, held_out):  # noqa: B020
        training.save(path, SETTINGS, stopped)
        break
    assert stopped.step == 20
    resumed = training.restored(path, SETTINGS)
    *_, resumed = training.train(SETTINGS, resumed, known, held_out)
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name]), name
    without_seconds = [[row[0], *row[2:]] for row in whole.curve]
    assert without_seconds == [[row[0], *row[2:]] for row in resumed.curve]


def test_a_checkpoint_of_other_settings_is_refused(tensors, tmp_path):
    known, _ = tensors
    path = tmp_path / "checkpoint.pt"
    training.save(path, SETTINGS, training.start(SETTINGS, known))
    with pytest.raises(ValueError, match="other settings"):
        training.restored(path, replace(SETTINGS, seed=1))


def test_a_run_leaves_weights_with_their_provenance(tmp_path):
    settings = replace(SETTINGS, data=SampleSizes(3, 60, 4_500), held_out=1, steps=20)
    with InProcess() as door:
        path = training_run.run(settings, tmp_path, door, "a test")
        made = read_pretrained(path)
        assert made.provenance["settings"] == asdict(settings)
        assert made.provenance["held_out"]["step"] == 20
        again = training_run.run(settings, tmp_path, door, "a test")  # finds everything done
    np.testing.assert_array_equal(read_pretrained(again).weights.packed, made.weights.packed)
    path.write_bytes(path.read_bytes()[:-4] + b"\0\0\0\0")
    with pytest.raises(ValueError, match="damaged"):
        read_pretrained(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('kind = "other"', "kind"),
        ("stepz = 3", "stepz: unknown"),
        ("steps = 0", "steps: must be at least 1"),
        ("batch = 1.5", "batch: must be a whole number"),
    ],
)
def test_bad_configurations_are_refused(tmp_path, line, message):
    kind = "" if line.startswith("kind") else 'kind = "conditioned"\n'
    text = f'{kind}{line}\nfamily = "paper"\n[data]\nqueries = 30\nstates = 10\nnodes = 4500\n'
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        TrainingSettings.load(path)
