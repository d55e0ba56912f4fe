"""Training by TRPO: many robots at once, resumable, with sb3-contrib's implementation.

The run's folder holds `checkpoint.zip` (sb3's own format, only ever read by the run that wrote it),
`curve.json`, and at the end `weights.safetensors`.
"""

import json
import logging
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sb3_contrib import TRPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from learning.trpo.policy import KIND, TrpoSettings, TrpoWeights
from learning.trpo.query_environment import QueryEnvironment
from learning.trpo.robot_batch import RobotBatch
from ocp.family_file import load_family
from ocp.files import atomic_path, write_text
from ocp.version import code_version

log = logging.getLogger(__name__)

COLUMNS = ("steps", "seconds", "reached", "cost", "return")
RECENT = 512  # episodes that the curve's figures are means over


class Robots(VecEnv):
    """Robots of a family as sb3's vectorised environment; who ends begins anew at once."""

    def __init__(self, settings: TrpoSettings, stream: int = 0) -> None:
        family = load_family(settings.family)
        seed = [settings.seed, stream]
        self.batch = RobotBatch(family.sample, settings.robots, settings.environment, seed)
        single = QueryEnvironment(self.batch.queries[0], settings.environment)
        self.render_mode = None
        super().__init__(settings.robots, single.observation_space, single.action_space)
        self.finished: list[tuple[bool, float, float]] = []
        self._cost, self._return = np.zeros(settings.robots), np.zeros(settings.robots)

    def reset(self) -> Any:
        for k in range(self.num_envs):
            self.batch.reset(k)
        self._cost[:], self._return[:] = 0.0, 0.0
        return self.batch.observations()

    def step_async(self, actions: Any) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        rewards, costs, arrived, late = self.batch.step(self._actions)
        self._cost += costs
        self._return += rewards
        done = arrived | late
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            last = self.batch.observations()
            for k in map(int, np.flatnonzero(done)):
                infos[k]["terminal_observation"] = last[k]
                infos[k]["TimeLimit.truncated"] = bool(late[k])
                self.finished.append((bool(arrived[k]), self._cost[k], self._return[k]))
                self._cost[k], self._return[k] = 0.0, 0.0
                self.batch.reset(k)
        self.finished = self.finished[-RECENT:]
        return self.batch.observations(), rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError(f"{attr_name}: the robots of a run cannot be changed")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        raise NotImplementedError(f"{method_name}: robots have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002
        return [False] * self.num_envs


class _Record(BaseCallback):
    """The curve and a checkpoint after every update."""

    def __init__(self, folder: Path, robots: Robots, rows: list[list[float]], every: int) -> None:
        super().__init__()
        self._folder, self._robots, self._rows, self._every = folder, robots, rows, every
        self._begun = time.perf_counter() - (rows[-1][1] if rows else 0.0)
        self._updates = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._updates += 1
        if self._updates % self._every == 0:
            self.keep()

    def keep(self) -> None:
        """Add a row to the curve and write it and the checkpoint."""
        recent = self._robots.finished
        reached = [cost for arrived, cost, _ in recent if arrived]
        self._rows.append(
            [
                self.model.num_timesteps,
                time.perf_counter() - self._begun,
                len(reached) / max(1, len(recent)),
                float(np.mean(reached)) if reached else 0.0,
                float(np.mean([total for _, _, total in recent])) if recent else 0.0,
            ]
        )
        log.info("steps %d, %.0f s: reached %.3f, cost %.3f, return %.3f", *self._rows[-1])
        with atomic_path(self._folder / "checkpoint.zip") as temporary:
            self.model.save(temporary)
        write_text(
            self._folder / "curve.json",
            json.dumps({"columns": COLUMNS, "rows": self._rows}, indent=1) + "\n",
        )


def train(settings: TrpoSettings, folder: Path, command: str = "") -> Path:
    """Train, going on from the folder's checkpoint if it has one; returns the weights' path.

    Robots, queries and noise are drawn anew after an interruption, so that a run that was stopped
    is as good as, but not bit for bit, one that was not.

    Raises:
        ValueError: if the folder holds a run with other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "settings.json"
    wanted = json.loads(json.dumps(asdict(settings)))
    if kept.exists() and json.loads(kept.read_text(encoding="utf-8")) != wanted:
        raise ValueError(f"{folder}: holds a run with other settings")
    write_text(kept, json.dumps(wanted, indent=1) + "\n")
    rows: list[list[float]] = []
    checkpoint = folder / "checkpoint.zip"
    if checkpoint.exists():
        rows = json.loads((folder / "curve.json").read_text(encoding="utf-8"))["rows"]
    robots = Robots(settings, stream=len(rows))
    model = TRPO.load(checkpoint, robots, device="cpu") if rows else _fresh(settings, robots)
    left = settings.steps - model.num_timesteps
    record = _Record(folder, robots, rows, every=10)
    if left > 0:
        model.learn(left, record, reset_num_timesteps=not rows)
        record.keep()
    path = folder / "weights.safetensors"
    weights(model, settings, {"command": command, "code": code_version()}, rows).save(path)
    return path


def _fresh(settings: TrpoSettings, robots: Robots) -> TRPO:
    shape = list(settings.hidden)
    return TRPO(
        "MlpPolicy",
        robots,
        n_steps=settings.rollout,
        batch_size=1024,
        gamma=settings.discount,
        gae_lambda=settings.gae,
        target_kl=settings.largest_divergence,
        learning_rate=settings.critic_rate,
        n_critic_updates=settings.critic_passes,
        policy_kwargs={"net_arch": {"pi": shape, "vf": shape}, "log_std_init": -0.5},
        seed=settings.seed,
        device="cpu",
    )


def weights(
    model: TRPO, settings: TrpoSettings, provenance: dict[str, Any], rows: list[list[float]]
) -> TrpoWeights:
    """The mean of the policy of `model`."""
    linear = [m for m in model.policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)]
    last_layer: Any = model.policy.action_net
    layers = tuple(
        (
            layer.weight.detach().numpy().astype(float),
            layer.bias.detach().numpy().astype(float),
        )
        for layer in [*linear, last_layer]
    )
    last = dict(zip(COLUMNS, rows[-1], strict=True)) if rows else {}
    versions = {"torch": torch.__version__, "kind": KIND}
    return TrpoWeights(layers, settings, {**provenance, "versions": versions, "last": last})
