"""The paper ledger: for every number the paper claims, its own recomputation, ours, the optimum."""

import json
from pathlib import Path

from sims.experiments import EXPERIMENTS, Entry, experiment
from sims.experiments.sheet import Sheet

COLUMNS = ("where", "claimed", "recomputed", "ours", "exact optimum", "remark")


def ledger(out: Path) -> Sheet:
    """The ledger of all experiments whose results lie in `out`."""
    sheet = Sheet("Paper ledger: Xu and Zhu, Meta Value Learning (RSS 2022)", COLUMNS)
    for name in EXPERIMENTS:
        path = out / f"{name}.json"
        if path.is_file():
            document = json.loads(path.read_text(encoding="utf-8"))
            try:
                entries = experiment(name).entries(document["findings"])
            except KeyError as missing:
                sheet.notes.append(f"{name}: by an older version, without {missing}; run it again.")
                continue
            mode = "quick" if document["quick"] else "full"
            machine = document["machine"]
            cores = f"{machine['cores']} cores, Python {machine['python']}"
            sheet.notes.append(f"{name}: {mode} run, seed {document['seed']}, {cores}.")
            for entry in entries:
                sheet.add(*cells(entry))
        else:
            sheet.notes.append(f"{name}: not run.")
    sheet.notes.append(
        '"Recomputed" is what the paper\'s own tables give; "absent" marks a method that was not '
        "run. Costs are of closed loops up to the first hit of the goal ball."
    )
    return sheet


def cells(entry: Entry) -> tuple[str, ...]:
    """An entry's columns."""
    return (
        entry.where,
        entry.claim,
        entry.recomputed,
        entry.ours,
        entry.optimum,
        entry.remark,
    )
