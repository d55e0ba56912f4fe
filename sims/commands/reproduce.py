"""`zermelo reproduce`: run the papers' tables and figures again and write the paper ledger."""

import json
import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ocp.files import write_text
from ocp.version import code_version
from sims.benchmarks import machine
from sims.exit_status import reading_input
from sims.experiments import EXPERIMENTS, Findings, Setting, experiment
from sims.experiments.ledger import ledger
from sims.parts import Parts

if TYPE_CHECKING:
    from sims import cli

log = logging.getLogger(__name__)
WIDTH = 118
DEFAULT_OUT = Path("out") / "reproduce"


def run(command: "cli.Reproduce") -> int:
    """Run the command; returns its exit status."""
    with reading_input():
        asked = command.names or ("all",)
        for name in asked:
            if name not in (*EXPERIMENTS, "all"):
                known = ", ".join([*EXPERIMENTS, "all"])
                raise ValueError(f"reproduce: {name!r} is unknown; known are {known}")
    names = list(EXPERIMENTS) if "all" in asked else list(dict.fromkeys(asked))
    out = command.out or DEFAULT_OUT
    setting = Setting(command.quick, command.seed, out)
    documents = {name: reproduce(name, setting) for name in names}
    sheet = ledger(out)
    sheet.write(out, "paper-ledger")
    if command.json:
        print(json.dumps({"out": str(out), "experiments": documents}))
    else:
        Console(stderr=True).print(f"tables, figures and the paper ledger: {out}")
    return 0


def reproduce(name: str, setting: Setting) -> dict[str, Any]:
    """Run one experiment and write its document, tables and figures."""
    module = experiment(name)
    begun = time.perf_counter()
    common = {"seed": setting.seed, "quick": setting.quick}
    findings = module.run(setting, Parts(setting.out / "parts", common))
    document = {
        "experiment": name,
        "quick": setting.quick,
        "seed": setting.seed,
        "machine": machine(),
        "code": code_version(),
        "seconds": time.perf_counter() - begun,
        "findings": findings.document,
    }
    text = json.dumps(document, indent=1, allow_nan=False)
    write_text(setting.out / f"{name}.json", text + "\n")
    show(findings)
    for stem, sheet in findings.sheets.items():
        sheet.write(setting.out, stem)
    for path in module.draw(json.loads(text)["findings"], setting.out):
        log.info("%s", path)
    return document


def show(findings: Findings) -> None:
    """The tables on the terminal, on standard error."""
    console = Console(stderr=True, width=max(Console(stderr=True).width, WIDTH))
    for sheet in findings.sheets.values():
        console.print(sheet.terminal())
