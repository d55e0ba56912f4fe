"""Configuration files: the paper's parameters by name, and nothing misspelt gets through."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from learning.faithful.config import Config, MetaSettings, Source
from learning.faithful.losses import Derivative, Reduction, Structure
from learning.faithful.value_network import Activation
from learning.shipped import CONFIGS
from ocp.set_valued import Image

FILES = sorted(CONFIGS.glob("*.toml"))
FAITHFUL = [p for p in FILES if 'kind = "faithful"' in p.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", FAITHFUL, ids=lambda p: p.stem)
def test_shipped_configurations_load_and_survive_a_round_trip(path: Path, tmp_path: Path) -> None:
    config = Config.load(path)
    copied = tmp_path / "copy.toml"
    copied.write_text(tomli_w.dumps(config.table()), encoding="utf-8")
    assert Config.load(copied) == config


def test_section_iv_b_holds_the_papers_numbers() -> None:
    config = Config.load(next(p for p in FAITHFUL if p.stem == "section-iv-b"))
    assert config.data.queries == 60
    assert abs(config.data.grid[0] * config.data.grid[1] * config.data.grid[2] - 118_000) < 300
    assert config.data.step == 0.4
    assert config.data.source is Source.SET_VALUED
    assert config.network.hidden == (256, 256, 256)
    assert config.network.activation is Activation.RELU
    assert config.network.structure is Structure.PLAIN
    assert not config.network.relative
    assert config.loss.multiplier == 0.1
    assert config.loss.reduction is Reduction.SUM
    meta = config.meta
    assert (meta.batch, meta.shots, meta.inner_rate, meta.inner_steps) == (10, 256, 1e-3, 1)
    assert meta.second_order
    assert meta.iterations >= 10_000
    adaptation = config.adaptation
    assert (adaptation.trajectories, adaptation.shots_per_trajectory) == (64, 32)
    assert (adaptation.steps, adaptation.rate) == (5, 1e-3)


BAD = [
    (("kind",), "fast", "kind"),
    (("sead",), 1, "sead: unknown"),
    (("meta", "iteration"), 5, r"meta\.iteration: unknown"),
    (("meta", "iterations"), 0, r"meta\.iterations: must be a positive"),
    (("meta", "iterations"), 2.5, r"meta\.iterations: must be a whole number"),
    (("meta", "inner_rate"), -1.0, r"meta\.inner_rate"),
    (("meta", "inner_steps"), -1, r"meta\.inner_steps"),
    (("network", "activation"), "tanh", r"network\.activation: must be one of relu, silu"),
    (("network", "hidden"), [0], r"network\.hidden"),
    (("loss", "multiplier"), float("nan"), r"loss\.multiplier"),
    (("loss", "difference_step"), 0.0, r"loss\.difference_step"),
    (("data", "family"), "other", r"data\.family"),
    (("data", "image"), "far", r"data\.image: must be one of ball, lateral, nearest"),
    (("adaptation", "goal_ratio"), 1.0, r"adaptation\.goal_ratio"),
    (("adaptation", "rate"), float("inf"), r"adaptation\.rate"),
    (("adaptation",), 3, "adaptation: must be a table"),
]


@pytest.mark.parametrize(("keys", "value", "message"), BAD)
def test_bad_fields_are_named(keys: tuple[str, ...], value: Any, message: str) -> None:
    table = copy.deepcopy(Config().table())
    place = table
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    with pytest.raises(ValueError, match=message):
        Config.from_table(table)


def test_what_is_no_toml_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text("kind = ", encoding="utf-8")
    with pytest.raises(ValueError, match="is not TOML"):
        Config.load(path)


def test_the_loss_is_the_configurations() -> None:
    config = Config(meta=MetaSettings(iterations=1))
    form = replace(config, loss=replace(config.loss, derivative=Derivative.AUTOMATIC)).lagrangian
    assert form.derivative is Derivative.AUTOMATIC
    assert form.multiplier == config.loss.multiplier
    assert Config.from_table(config.table()).data.image is Image.NEAREST
