"""Algorithm 1: one step longhand, second-order terms by numerical differentiation, resuming."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faithful_references import FORMS, form_name, of_query, random_samples, small_networks

from learning.faithful.config import Config, DataSettings, MetaSettings, NetworkSettings
from learning.faithful.losses import Lagrangian, Samples, lagrangian
from learning.faithful.meta import MetaTraining, MetaWeights, inner_steps, meta_gradient, train
from learning.faithful.value_network import Activation, Parameters, expanded, network

ALPHA = 1e-3

SMALL = Config(
    data=DataSettings(queries=3, grid=(26, 26, 17), step=0.85),
    network=NetworkSettings(hidden=(8, 8)),
    meta=MetaSettings(iterations=6, batch=2, shots=16, outer_shots=12),
)


def batches() -> tuple[Samples, Samples]:
    return random_samples(0), random_samples(1)


def loss_after(theta: Parameters, form: Lagrangian, steps: int) -> torch.Tensor:
    """The objective (14) on the two batches."""
    inner, outer = batches()
    return lagrangian(
        inner_steps(expanded(theta, 3), inner, form, ALPHA, steps), outer, form
    ).mean()


def test_one_inner_step_longhand() -> None:
    """A linear one-layer network on two samples, (15) written out with the sums of (9) and (11)."""
    form = Lagrangian(0.5)
    samples = of_query(random_samples(3, k=2), 0)
    theta = (torch.zeros(1, 4, dtype=torch.float64), torch.tensor([0.25], dtype=torch.float64))
    moved = inner_steps(theta, samples, form, ALPHA, 1)
    # N(x) = W x + b: dN/dW = x, and a difference rate (N(x') - N(x)) has slope rate (x' - x).
    gradient_W, gradient_b = np.zeros(4), 0.0
    for k in range(2):
        x, V = samples.features[k].numpy(), float(samples.values[k])
        gradient_W += 2 * (0.25 - V) * x
        gradient_b += 2 * (0.25 - V)
        for j in range(2):
            rate = float(samples.rates[j])
            slope = rate * (samples.shifted[j, k].numpy() - x)
            predicted = 0.0  # W = 0
            gradient_W += 0.5 * 2 * (predicted - float(samples.inputs[k, j])) * slope
    assert moved[0][0].numpy() == pytest.approx(-ALPHA * gradient_W, rel=1e-12)
    assert float(moved[1]) == pytest.approx(0.25 - ALPHA * gradient_b, rel=1e-12)


@pytest.mark.parametrize("steps", [0, 1, 3])
@pytest.mark.parametrize("form", FORMS, ids=form_name)
def test_second_order_terms_match_numerical_differentiation(form: Lagrangian, steps: int) -> None:
    theta = small_networks(form.activation)
    inner, outer = batches()
    found = meta_gradient(theta, inner, outer, form, ALPHA, steps)
    assert float(found.losses[1]) == pytest.approx(float(loss_after(theta, form, steps)), rel=1e-9)
    generator = torch.Generator().manual_seed(5)
    for _ in range(2):
        along = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in theta]
        step = 1e-7  # small: relu's kinks must not lie between the ends
        ends = [
            float(
                loss_after(tuple(p + s * d for p, d in zip(theta, along, strict=True)), form, steps)
            )
            for s in (step, -step)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        slope = float(sum((g * d).sum() for g, d in zip(found.gradient, along, strict=True)))
        assert slope == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_leaving_the_hessian_out_changes_the_gradient() -> None:
    """Else the test above could not see it."""
    form = Lagrangian(0.3)
    theta = small_networks(form.activation)
    both = [
        meta_gradient(theta, *batches(), form, 0.02, 1, second_order=o).gradient[0]
        for o in (True, False)
    ]
    assert (both[0] - both[1]).abs().max() > 1e-3 * both[0].abs().max()


def test_the_gradient_does_not_depend_on_how_queries_are_chunked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    form = Lagrangian(0.3)
    theta = small_networks(form.activation)
    found = []
    for chunk in (1, 2, 3):
        monkeypatch.setattr("learning.faithful.meta.CHUNK", chunk)
        found.append(meta_gradient(theta, *batches(), form, ALPHA))
    for other in found[1:]:
        assert torch.allclose(found[0].losses, other.losses)
        for a, b in zip(found[0].gradient, other.gradient, strict=True):
            assert torch.allclose(a, b)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    return train(SMALL, folder)


def test_training_resumes_to_the_same_bits(tmp_path: Path, trained: Path) -> None:
    half = MetaTraining(SMALL)
    for _ in range(3):
        half.step()
    half.save(tmp_path / "checkpoint.safetensors")
    resumed = MetaWeights.load(train(SMALL, tmp_path))
    whole = MetaWeights.load(trained)
    assert resumed.iterations == whole.iterations == 6
    for a, b in zip(resumed.parameters, whole.parameters, strict=True):
        assert torch.equal(a, b)
    curves = [(p / "curve.json").read_text() for p in (tmp_path, trained.parent)]
    assert curves[0] == curves[1]


def test_training_lowers_the_loss_after_the_inner_step() -> None:
    training = MetaTraining(replace(SMALL, meta=replace(SMALL.meta, iterations=400)))
    for _ in range(150):
        training.step()
    curve = np.array(training.curve)[:, 1]
    assert np.median(curve[-20:]) < 0.5 * np.median(curve[:20])


def test_a_checkpoint_of_another_configuration_is_refused(trained: Path) -> None:
    other = replace(SMALL, meta=replace(SMALL.meta, inner_rate=2e-3))
    with pytest.raises(ValueError, match="another configuration"):
        MetaTraining(other).restore(trained.parent / "checkpoint.safetensors")
    reseeded = replace(SMALL, seed=1)
    with pytest.raises(ValueError, match="another configuration"):
        train(reseeded, trained.parent)


def test_more_iterations_may_be_asked_for_later(trained: Path) -> None:
    longer = MetaTraining(replace(SMALL, meta=replace(SMALL.meta, iterations=9)))
    longer.restore(trained.parent / "checkpoint.safetensors")
    assert longer.iteration == 6


def test_weights_keep_their_configuration_and_parameters(trained: Path) -> None:
    weights = MetaWeights.load(trained)
    assert weights.config == SMALL
    assert weights.robot.name == "unicycle"
    features = torch.zeros(5, 4)
    assert network(weights.parameters, features, Activation.RELU).shape == (5,)


@pytest.mark.parametrize("offset", [4, 400, -8])
def test_corrupted_weights_are_refused(tmp_path: Path, trained: Path, offset: int) -> None:
    damaged = bytearray(trained.read_bytes())
    damaged[offset] ^= 0xFF
    path = tmp_path / "damaged.safetensors"
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="damaged"):
        MetaWeights.load(path)


def test_truncated_missing_and_foreign_weights_are_refused(tmp_path: Path, trained: Path) -> None:
    from learning.weights import save_tensors

    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(trained.read_bytes()[:-100])
    with pytest.raises(ValueError, match="damaged"):
        MetaWeights.load(cut)
    with pytest.raises(FileNotFoundError, match=r"nothing\.safetensors"):
        MetaWeights.load(tmp_path / "nothing.safetensors")
    save_tensors(tmp_path / "other.safetensors", {"a": torch.zeros(1)}, {})
    with pytest.raises(ValueError, match="configuration"):
        MetaWeights.load(tmp_path / "other.safetensors")
    record = {"config": SMALL.table()}
    wrong = {f"parameter.{i}": torch.zeros(2) for i in range(6)}
    save_tensors(tmp_path / "wrong.safetensors", wrong, record)
    with pytest.raises(ValueError, match=r"parameter\.0 must have shape"):
        MetaWeights.load(tmp_path / "wrong.safetensors")
    save_tensors(tmp_path / "nan.safetensors", {"parameter.0": torch.full((2,), torch.nan)}, record)
    with pytest.raises(ValueError, match="not finite"):
        MetaWeights.load(tmp_path / "nan.safetensors")


def test_a_grid_too_coarse_for_the_goal_is_refused() -> None:
    coarse = replace(SMALL, data=replace(SMALL.data, grid=(10, 10, 7), step=2.3))
    with pytest.raises(ValueError, match=r"data\.grid"):
        MetaTraining(coarse)


def test_divergence_is_said_not_stored() -> None:
    wild = replace(SMALL, meta=replace(SMALL.meta, inner_rate=1e30))
    with pytest.raises(FloatingPointError, match="inner_rate"):
        MetaTraining(wild).step()
