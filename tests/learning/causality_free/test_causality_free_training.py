"""Training: lowers the error against exact costs, goes on where it stopped, keeps its promises."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from causality_free_problems import SMALL, random_weights

from learning.causality_free.adaptation import adapt
from learning.causality_free.exact import exact_trajectories
from learning.causality_free.families import FAMILIES, get_family
from learning.causality_free.network import Weights
from learning.causality_free.planner import CausalityFreePlanner
from learning.causality_free.pretrained import Pretrained, load_pretrained, pretrained_for
from learning.causality_free.run import run
from learning.causality_free.samples import POINTS, Samples
from learning.causality_free.training import (
    TrainingSettings,
    TrainingState,
    family_query,
    gather_here,
    restored,
    save,
    start,
    train,
)
from learning.shipped import CONFIGS
from ocp.execution import InProcess
from ocp.planning import trajectories
from ocp.query import Equilibrium
from ocp.regulation import RegulatorValue
from ocp.trajectory import SolveError, Status


@pytest.fixture(scope="module")
def finished() -> TrainingState:
    return _to_the_end(start(SMALL))


def _to_the_end(state: TrainingState) -> TrainingState:
    """`train` goes on with the state it is given."""
    for _ in train(SMALL, state):
        pass
    return state


def tensors(state: TrainingState) -> list[torch.Tensor]:
    return [t.detach().clone() for t in state.weights.tensors().values()]


def trained(state: TrainingState) -> Pretrained:
    known = SMALL.queries - SMALL.held_out
    queries = [family_query(get_family("car"), SMALL.seed, k) for k in range(known)]
    weights = Weights.of({n: t.detach() for n, t in state.weights.tensors().items()})
    return Pretrained.of(get_family("car"), weights, queries)


def test_training_lowers_the_error_against_exact_costs(finished) -> None:
    """From starts never trained on, V is nearer the exact costs than V_LQR, where it began."""
    errors: list[list[float]] = []
    for k in range(2):
        query = family_query(get_family("car"), SMALL.seed, k)
        value, linear = trained(finished).value(query), RegulatorValue(query)
        starts = get_family("car").starts(query, 10, np.random.default_rng(5))
        for o in exact_trajectories(query, [linear], starts):
            if o is not None:
                rivals = (value.value(o.motion.start), linear.value(o.motion.start))
                errors.append([abs(float(np.log(v / o.cost))) for v in rivals])
    own, linears = np.mean(errors, axis=0)
    assert own < 0.7 * linears


def test_rounds_add_motions_of_the_queries_trained_on(finished) -> None:
    assert [len(r) for r in finished.rounds] == [5, 3]
    assert sum(len(s) for s in finished.rounds[0]) > 0.8 * 5 * 12 * POINTS
    assert sum(len(s) for s in finished.rounds[1]) > 0.8 * 3 * 3 * POINTS
    assert [row[0] for row in finished.curve] == [100, 200, 300, 400, 500]


def test_a_resumed_run_equals_an_uninterrupted_one(finished, tmp_path) -> None:
    """Stopped in either round, saved, loaded: the same weights to the bit."""
    state = start(SMALL)
    for stop in (200, 400):
        for reached in train(SMALL, state):
            if reached.step == stop:
                break
        save(tmp_path / "c.pt", SMALL, state)
        state = restored(tmp_path / "c.pt", SMALL)
        assert state.step == stop
    _to_the_end(state)
    assert all(torch.equal(a, b) for a, b in zip(tensors(state), tensors(finished), strict=True))


def test_a_checkpoint_of_other_settings_is_refused(finished, tmp_path) -> None:
    save(tmp_path / "c.pt", SMALL, finished)
    with pytest.raises(ValueError, match="other settings"):
        restored(tmp_path / "c.pt", replace(SMALL, seed=1))


def test_a_run_in_a_folder_ships_its_weights(tmp_path) -> None:
    short = replace(SMALL, queries=3, held_out=1, motions=(2,), steps=(10,), checkpoint_steps=5)
    path = run(short, tmp_path, InProcess(), "zermelo train this")
    network = Pretrained.load(path)
    assert network.provenance["command"] == "zermelo train this"
    assert network.provenance["settings"]["family"] == "car"
    before = network.weights.tensors()
    again = run(short, tmp_path, InProcess(), "zermelo train this")  # nothing is left to do
    after = Pretrained.load(again).weights.tensors()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_weights_come_back_as_they_were(tmp_path) -> None:
    family = get_family("quadrotor")
    weights = random_weights(family, 3)
    query = family.sample(np.random.default_rng(0))
    network = Pretrained.of(family, weights, [query])
    network.save(tmp_path / "w.safetensors")
    back = Pretrained.load(tmp_path / "w.safetensors")
    for name, tensor in weights.tensors().items():
        assert torch.equal(back.weights.tensors()[name], tensor)
    x = family.starts(query, 10, np.random.default_rng(1))
    slopes = network.value(query).gradient(x)
    assert np.allclose(back.value(query).gradient(x), slopes, rtol=1e-12, atol=1e-12)
    damaged = bytearray((tmp_path / "w.safetensors").read_bytes())
    damaged[-9] ^= 1
    (tmp_path / "w.safetensors").write_bytes(damaged)
    with pytest.raises(ValueError, match="damaged"):
        Pretrained.load(tmp_path / "w.safetensors")


def test_weights_that_do_not_fit_are_refused() -> None:
    named = random_weights(get_family("car"), 0).tensors()
    with pytest.raises(ValueError, match="need"):
        Weights.of({n: t for n, t in named.items() if n != "last"})
    with pytest.raises(ValueError, match=r"hidden\.1"):
        Weights.of({**named, "hidden.1.bias": named["hidden.1.bias"][:-1]})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"family": "boat"}, "family"),
        ({"steps": (10,)}, "steps"),
        ({"motions": (0, 1)}, "motions"),
        ({"rate": float("nan")}, "rate"),
        ({"held_out": 5}, "queries"),
        ({"batch": 0}, "batch"),
    ],
)
def test_bad_settings_are_refused(change, message) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change)


def test_a_configuration_is_read_strictly(tmp_path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('kind = "causality-free"\nfamily = "car"\nmotions = [3]\nsteps = [5]\n')
    assert TrainingSettings.load(path) == TrainingSettings("car", motions=(3,), steps=(5,))
    for text, message in (
        ('kind = "causality-free"\n', "family: missing"),
        ('kind = "causality-free"\nfamily = "car"\nspeed = 3\n', "speed: unknown"),
        ('kind = "causality-free"\nfamily = "car"\nsteps = 5\n', "steps: must be a list"),
        ('kind = "causality-free"\nfamily = "car"\n[loss]\nvalue = "x"\n', "loss.value"),
        ('kind = "other"\nfamily = "car"\n', "kind"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            TrainingSettings.load(path)


def test_the_planner_refines_and_never_gets_worse(finished) -> None:
    query = family_query(get_family("car"), SMALL.seed, 0)
    planner = CausalityFreePlanner(trained(finished), most=12)
    asked_for = query.reference + np.array([0.5, -0.5, 0.1, 0.2, 0.0])
    state = planner.start(query, [asked_for])
    scores, counts = [state.score], [state.trajectories]
    while not state.finished:
        before = state
        state = planner.refine(state)
        assert before.trajectories == counts[-1]  # its argument is left alone
        scores.append(state.score)
        counts.append(state.trajectories)
    assert (counts[0], counts[-1]) == (0, 12)
    assert max(np.diff(counts)) <= 8
    assert (np.diff(scores) <= 0).all()
    assert any(np.array_equal(o.motion.start, asked_for) for o in state.optima)
    assert planner.refine(state) is state
    answer = planner.plan(query, until=trajectories(8))
    assert 8 <= answer.trajectories <= 12
    assert np.isfinite(answer.policy(asked_for)).all()


def test_exact_motions_of_a_query_improve_a_briefly_trained_network(finished) -> None:
    """On a query that it was not trained on: lower residuals, nearer the exact costs elsewhere."""
    family = get_family("car")
    query = family_query(family, SMALL.seed, SMALL.queries - 1)
    network = trained(finished)
    value = replace(network, lower=network.lower - 9, upper=network.upper + 9).value(query)
    rng = np.random.default_rng(9)
    linear = RegulatorValue(query)
    known, fresh = (
        [o for o in exact_trajectories(query, [linear], family.starts(query, 16, rng)) if o]
        for _ in range(2)
    )
    adapted = adapt(value, Samples.of(query, known), family.starts(query, 100, rng))
    assert adapted.strength < np.inf
    assert adapted.after < adapted.before
    starts, costs = np.array([o.motion.start for o in fresh]), np.array([o.cost for o in fresh])
    errors = [np.abs(np.log(v.value(starts) / costs)).mean() for v in (adapted.value, value)]
    assert errors[0] < 0.8 * errors[1]


def test_queries_of_other_families_are_refused(finished) -> None:
    network = trained(finished)
    query = family_query(get_family("car"), SMALL.seed, 0)
    drone = get_family("quadrotor").sample(np.random.default_rng(0))
    slow = replace(query, goal=Equilibrium((0.0, 0.0, 0.0, 1.2, 0.0), 0.2))
    assert network.why_unknown(slow) is None
    elsewhere = replace(query, goal=Equilibrium((1.0, -1.0, 0.0, 1.2, 0.0), 0.1))
    assert network.why_unknown(elsewhere) is None
    strong = replace(query, input_upper=(50.0, 50.0), input_lower=(-0.01, -0.01))
    for other, reason in ((drone, "another robot"), (strong, "outside the family")):
        with pytest.raises(SolveError, match=reason) as refused:
            network.value(other)
        assert refused.value.status is Status.NOT_APPLICABLE


def test_gathering_is_the_same_wherever_it_is_done() -> None:
    from learning.causality_free.run import gather_through
    from learning.causality_free.training import gather_tasks

    tasks = gather_tasks(replace(SMALL, motions=(2, 2)), 0, start(SMALL).weights)[:2]
    here, through = gather_here(tasks), gather_through(InProcess())(tasks)
    for a, b in zip(here, through, strict=True):
        assert np.array_equal(a.costates, b.costates)


@pytest.mark.parametrize("name", FAMILIES)
def test_shipped_weights_are_those_of_the_shipped_configuration(name) -> None:
    settings = TrainingSettings.load(CONFIGS / f"causality-free-{name}.toml")
    network = load_pretrained(name)
    told = network.provenance["settings"]
    assert TrainingSettings(**{**told, **as_tuples(told), "loss": settings.loss}) == settings
    assert told["loss"] == asdict(settings.loss)
    fresh = network.family.sample(np.random.default_rng(2_000_000))
    assert network.why_unknown(fresh) is None
    assert pretrained_for(fresh) is network


def as_tuples(table: dict) -> dict[str, tuple]:
    """TOML has no tuples."""
    return {name: tuple(value) for name, value in table.items() if isinstance(value, list)}
