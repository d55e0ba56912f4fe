"""Training on two processes follows that of one, and writes the same files."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from learning.conditioned import training
from learning.conditioned.network_weights import NetworkWeights
from learning.conditioned.training import TrainingSettings
from learning.conditioned.training_data import family_tensors
from learning.conditioned.training_run import sampled
from learning.shipped import CONFIGS
from ocp.execution import open_door

CONFIG = """\
kind = "conditioned"
family = "paper"
steps = 40
batch = 65
warm_up = 5
held_out = 1
checkpoint_steps = 20
[data]
queries = 3
states = 60
nodes = 4500
[widths]
member = 8
trunk = 12
heads = 2
"""
ZERMELO = Path(sys.executable).with_name("zermelo")
LAUNCHER = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--no-python"]


def train(config: Path, folder: Path, launcher: list[str]) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [*launcher, str(ZERMELO), "train", str(config), "--out", str(folder), "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env=environment,
    )


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(tmp_path):
    """The batch of 65 splits unevenly; weights differ by the rounding of single precision only."""
    config = tmp_path / "small.toml"
    config.write_text(CONFIG)
    curves, weights = [], []
    for name, launcher in (("one", []), ("two", LAUNCHER)):
        folder = tmp_path / name
        answer = train(config, folder, launcher)
        assert answer.returncode == 0, answer.stderr
        assert len(json.loads(answer.stdout)) == 1  # the leader alone speaks
        curves.append(json.loads((folder / "small" / "curve.json").read_text())["rows"])
        weights.append(NetworkWeights.load(folder / "small" / "weights.safetensors").packed)
    assert [row[0] for row in curves[1]] == [20, 40]
    for one, two in zip(*curves, strict=True):
        np.testing.assert_allclose(two[2:], one[2:], rtol=1e-3)
    assert not np.array_equal(*weights)  # two partial sums: the work was divided
    np.testing.assert_allclose(weights[1], weights[0], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [([], LAUNCHER), (LAUNCHER, [])], ids=["1-2", "2-1"])
def test_a_run_goes_on_with_another_number_of_processes(before, after, tmp_path):
    """From the checkpoint at half time: the curve is that of a run which was never stopped."""
    config = tmp_path / "small.toml"
    config.write_text(CONFIG)
    settings = TrainingSettings.load(config)
    folder = tmp_path / "run" / "small"
    assert train(config, folder.parent, before).returncode == 0
    whole = json.loads((folder / "curve.json").read_text())["rows"]
    weights = NetworkWeights.load(folder / "weights.safetensors").packed

    with open_door() as door:
        samples = sampled(settings, folder, door)
    known, held_out = family_tensors(samples[:-1]), family_tensors(samples[-1:])
    half = next(training.train(settings, training.start(settings, known), known, held_out))
    assert half.step == 20
    training.save(folder / "checkpoint.pt", settings, half)
    (folder / "weights.safetensors").unlink()

    assert train(config, folder.parent, after).returncode == 0
    rows = json.loads((folder / "curve.json").read_text())["rows"]
    assert [row[0] for row in rows] == [20, 40]
    assert rows[0] == list(half.curve[0])  # taken over, not trained again
    np.testing.assert_allclose(rows[1][2:], whole[1][2:], rtol=1e-3)
    again = NetworkWeights.load(folder / "weights.safetensors").packed
    np.testing.assert_allclose(again, weights, atol=1e-3)


@pytest.mark.slow
def test_a_kind_that_cannot_be_divided_is_refused(tmp_path):
    answer = train(CONFIGS / "section-iv-b.toml", tmp_path, LAUNCHER)
    assert answer.returncode != 0
    assert "only 'conditioned' trains on several processes, got 'faithful'" in answer.stderr
