"""The command `zermelo`. Each command is a frozen dataclass; its field docs are its help.

Only what parsing needs is imported here; a command imports its own machinery when it runs.
Exit status: 0 success, 2 bad input, 3 nothing that was asked could be solved.
"""

import logging
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Literal

import tyro

from ocp.threads import one_thread_by_default
from sims.benchmarks import BENCHMARKS
from sims.demos import DEMOS
from sims.exit_status import BAD_INPUT, BadInputError, reading_input


@dataclass(frozen=True)
class Common:
    """Options of every command."""

    seed: int = 0
    """Seed of everything random."""
    out: Path | None = None
    """Folder for pictures and data; made if it does not exist."""
    json: bool = False
    """Print one JSON document on standard output, and nothing else there."""

    def prepare_out(self) -> None:
        """Make the output folder, so that a wrong one is refused before any work."""
        if self.out is not None:
            with reading_input():
                self.out.mkdir(parents=True, exist_ok=True)
                with TemporaryFile(dir=self.out):  # no name that another run could use too
                    pass


@dataclass(frozen=True)
class Plan(Common):
    """Plan a query: a feedback policy, its closed loops from the starts, the exact optimum beside.

    Example: zermelo plan sims/queries/paper-4-4.toml --start -4 -4 -0.785398
    """

    query: tyro.conf.Positional[Path] = tyro.MISSING
    """Query file (TOML)."""
    start: tyro.conf.UseAppendAction[tuple[tuple[float, ...], ...]] = ()
    """A start state, all its coordinates; repeat the option for more starts."""
    method: str | None = None
    """adapt, exact, eikonal, set-valued or another of sims/methods.py. By default adapt, or eikonal
    for queries that adapt's networks were not trained for (the output says so)."""
    deadline: float | None = None
    """Seconds until the policy must be ready."""
    trajectories: int | None = None
    """Exact trajectories to use at most, for the methods that learn from them."""
    no_exact: bool = False
    """Leave out the exact optimum."""
    cluster: str | None = None
    """Address of a Dask scheduler, whose workers find the exact optima."""

    def run(self) -> int:
        from sims.commands.plan import run

        return run(self)


@dataclass(frozen=True)
class Demo(Common):
    """Run a scripted demo, one for each capability."""

    name: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(help=" ".join(f"{name}: {what}." for name, what in DEMOS.items())),
    ] = tyro.MISSING

    def run(self) -> int:
        from sims.demos import run

        return run(self)


@dataclass(frozen=True)
class Regulate(Common):
    """Learn to regulate an unknown linear plant, the exact Riccati solution beside.

    Example: zermelo regulate sims/systems/rover.toml
    """

    system: tyro.conf.Positional[Path] = tyro.MISSING
    """System file (TOML)."""
    learner: str = "q-learning"
    """q-learning (the law that converges), paper-literal or paper-repaired."""

    def run(self) -> int:
        from sims.commands.regulate import run

        return run(self)


@dataclass(frozen=True)
class Navigate(Common):
    """Drive robots of unknown dynamics across a world whose obstacles come, go and move.

    Example: zermelo navigate sims/scenarios/figure-2.toml --out out
    """

    scenario: tyro.conf.Positional[Path] = tyro.MISSING
    """Scenario file (TOML)."""
    controller: str = "q-learning"
    """q-learning (the law that converges), paper-literal, paper-repaired, riccati or open-loop."""

    def run(self) -> int:
        from sims.commands.navigate import run

        return run(self)


@dataclass(frozen=True)
class Reproduce(Common):
    """Run the papers' tables and figures again; write them and the paper ledger to --out.

    A run that was stopped goes on where it was. Example: zermelo reproduce all --quick --out out
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """table1, table2, table3, fig1, fig2, fig3, rrtqx-fig2 or all (the default)."""
    quick: bool = False
    """Fewer starts, queries and repetitions: minutes instead of an hour."""

    def run(self) -> int:
        from sims.commands.reproduce import run

        return run(self)


@dataclass(frozen=True)
class Bench(Common):
    """Measure what the project claims: accuracy, success, time."""

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            help="All of them if none is named. "
            + " ".join(f"{name}: {what}." for name, what in BENCHMARKS.items())
        ),
    ] = ()

    compare: Path | None = None
    """A result (bench.json) to compare with: prints what moved by more than noise."""

    def run(self) -> int:
        from sims.commands.bench import run

        return run(self)


@dataclass(frozen=True)
class Store(Common):
    """Look into a value store, check it, merge stores, export or fill one.

    Example: zermelo store fill values --count 100 --workers 2; zermelo store verify values
    """

    action: tyro.conf.Positional[Literal["list", "verify", "merge", "export", "fill"]] = (
        tyro.MISSING
    )
    """list entries; verify every hash; merge the other stores into the first; export query files
    and arrays to --out; fill with what is missing of the answers to queries."""
    store: tyro.conf.Positional[Path] = tyro.MISSING
    """The store's folder."""
    others: tyro.conf.Positional[tuple[Path, ...]] = ()
    """merge: stores to take entries from. fill: query files, instead of --count random ones."""
    count: int = 100
    """fill: queries to draw from the paper's family."""
    solver: str = "eikonal"
    """fill: eikonal (values on a grid) or exact (costs at random starts)."""
    nodes: int | None = None
    """fill: size of the grid."""
    workers: int = 0
    """fill: local worker processes; 0 works in this one."""
    cluster: str | None = None
    """fill: a Dask scheduler's address, such as tcp://127.0.0.1:8786, instead of --workers."""

    def run(self) -> int:
        from sims.commands.store import run

        return run(self)


@dataclass(frozen=True)
class Live(Common):
    """Open a window in the browser: sliders move goal, obstacles and start, and policies follow."""

    query: tyro.conf.Positional[Path | None] = None
    """Query file (TOML) of a robot in the plane; by default the paper's with its goal at (1, 4)."""
    method: str | None = None
    """The method to begin with."""
    port: int | None = None
    """Port on this machine; by default the first free one from 7000 on."""
    seconds: float | None = None
    """End by itself after so many seconds."""

    def run(self) -> int:
        from sims.live.window import run

        return run(self)


@dataclass(frozen=True)
class Train(Common):
    """Train the networks behind `plan`: what is shipped again, or a configuration of one's own.

    Example: zermelo train learning/configs/paper.toml --out runs
    """

    config: tyro.conf.Positional[Path | None] = None
    """Configuration (TOML); by default those of both shipped networks, one after the other. A run
    that was stopped goes on where it was."""
    workers: int = 0
    """Local worker processes that sample the data; 0 works in this one."""
    cluster: str | None = None
    """A Dask scheduler's address, such as tcp://127.0.0.1:8786, instead of --workers."""

    def run(self) -> int:
        from sims.commands.train import run

        return run(self)


Command = (
    Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Regulate, tyro.conf.subcommand("regulate")]
    | Annotated[Navigate, tyro.conf.subcommand("navigate")]
    | Annotated[Store, tyro.conf.subcommand("store")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Live, tyro.conf.subcommand("live")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


def main() -> None:
    """Parse the command line, run the command, exit with its status."""
    one_thread_by_default()
    try:
        command = tyro.cli(
            Command,  # pyright: ignore[reportArgumentType]
            prog="zermelo",
            description="Near-optimal feedback policies, with the exact optimum beside them.",
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(message)s")
        command.prepare_out()
        status = command.run()
    except BadInputError as error:
        print(f"zermelo: {error}", file=sys.stderr)
        status = BAD_INPUT
    except KeyboardInterrupt:
        print("zermelo: interrupted", file=sys.stderr)
        status = 130
    except BrokenPipeError:  # nobody reads on, as behind `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 141
    sys.exit(status)
