"""`zermelo train`: make the shipped weights again, or others; resumable, with a training curve."""

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ocp.execution import open_door
from ocp.query_file import read_toml
from sims.exit_status import BadInputError, reading_input

if TYPE_CHECKING:
    from learning.conditioned.data_parallel import Crew
    from sims import cli

notes = Console(stderr=True)

SHIPPED = ("paper", "general")
PRELOAD = ("learning.conditioned.value_samples",)
EXACT_PRELOAD = ("learning.causality_free.training",)


def run(command: "cli.Train") -> int:
    """Run the command, on all processes that torch's launcher started; returns its exit status."""
    from learning.conditioned.data_parallel import launched

    with launched() as crew:
        if not crew.leads:
            notes.quiet = True
            logging.getLogger().setLevel(logging.WARNING)
        return _run(command, crew)


def _run(command: "cli.Train", crew: "Crew") -> int:
    from learning.causality_free import training as causality_free
    from learning.conditioned import training
    from learning.faithful import config as faithful
    from learning.shipped import CONFIGS
    from learning.trpo import policy as trpo

    paths = [command.config] if command.config else [CONFIGS / f"{n}.toml" for n in SHIPPED]
    with reading_input():
        kinds = [read_toml(path).get("kind") for path in paths]
        settings: list[Any] = []
        for path, kind in zip(paths, kinds, strict=True):
            if kind == training.KIND:
                settings.append(training.TrainingSettings.load(path))
            elif kind == faithful.KIND:
                settings.append(faithful.Config.load(path))
            elif kind == trpo.KIND:
                settings.append(trpo.TrpoSettings.load(path))
            elif kind == causality_free.KIND:
                settings.append(causality_free.TrainingSettings.load(path))
            else:
                kinds_known = (training.KIND, faithful.KIND, trpo.KIND, causality_free.KIND)
                known = ", ".join(kinds_known)
                raise ValueError(f"{path}: kind: {kind!r} is unknown; known are {known}")
            if crew.size > 1 and kind != training.KIND:
                raise ValueError(
                    f"{path}: kind: only {training.KIND!r} trains on several processes, "
                    f"got {kind!r}"
                )
    document = []
    for path, one in zip(paths, settings, strict=True):
        folder = (command.out or Path("training")) / path.stem
        folder.mkdir(parents=True, exist_ok=True)
        notes.print(f"training {path.stem} in {folder}; run the command again to go on")
        document.append(_train(one, path, folder, command, crew))
        if crew.leads:
            figure(folder / "curve.json", folder / "curve.png")
    if command.json and crew.leads:
        print(json.dumps(document))
    return 0


def _train(
    settings: Any, path: Path, folder: Path, command: "cli.Train", crew: "Crew"
) -> dict[str, Any]:
    from learning.causality_free.training import TrainingSettings as CausalityFreeSettings
    from learning.conditioned.training import TrainingSettings
    from learning.trpo.policy import TrpoSettings

    if isinstance(settings, CausalityFreeSettings):
        from learning.causality_free.run import run as train_causality_free

        how = f"zermelo train {path.parent.name}/{path.name}"
        with reading_input(), open_door(command.workers, command.cluster, EXACT_PRELOAD) as door:
            weights = train_causality_free(settings, folder, door, how)
    elif isinstance(settings, TrainingSettings):
        from learning.conditioned.training_run import run as train

        how = f"zermelo train {path.parent.name}/{path.name}"
        with reading_input(), open_door(command.workers, command.cluster, PRELOAD) as door:
            weights = train(settings, folder, door, how, crew)
    elif isinstance(settings, TrpoSettings):
        try:
            from learning.trpo.training import train as train_trpo
        except ImportError as error:
            raise BadInputError(f"{path}: training by TRPO needs the extra rl: {error}") from error

        with reading_input():
            weights = train_trpo(settings, folder, f"zermelo train {path.parent.name}/{path.name}")
    else:
        from learning.faithful.meta import train as train_faithful

        with reading_input():
            weights = train_faithful(settings, folder)
    curve = json.loads((folder / "curve.json").read_text(encoding="utf-8"))
    last = dict(zip(curve["columns"], curve["rows"][-1], strict=True))
    return {"config": str(path), "weights": str(weights), "last": last}


def figure(curve: Path, out: Path) -> None:
    """The training curve as a picture: every column against the first."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    table = json.loads(curve.read_text(encoding="utf-8"))
    columns, rows = table["columns"], table["rows"]
    signed = any(value <= 0 for row in rows for value in row[1:])
    drawn, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    counts = columns[0] in ("step", "steps")
    steps = [row[0] for row in rows] if counts else list(range(1, len(rows) + 1))
    for k, name in enumerate(columns):
        if name not in ("step", "steps", "seconds"):
            axes.plot(steps, [row[k] for row in rows], label=name)
    axes.set_yscale("symlog" if signed else "log")
    axes.set_xlabel("step")
    axes.set_ylabel("loss")
    axes.grid(which="both", alpha=0.3)
    axes.legend(frameon=False)
    save(drawn, out)
