"""Table II: the time of every component."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from ocp.execution import open_door
from ocp.mpc import receding_horizon
from ocp.query_family import PAPER_START, paper_query, sample_start
from sims.experiments import Entry, Findings, Setting
from sims.experiments.contestants import CONTESTANTS
from sims.experiments.generation import PRELOAD, generated
from sims.experiments.measure import on_the_four_queries
from sims.experiments.paper import GOALS, TABLE_II
from sims.experiments.sheet import ABSENT, Sheet, seconds
from sims.experiments.table1 import skipped
from sims.parts import Parts

WORKERS = (1, 2, 4)
TRAJECTORIES = 8
INSTANTS = 40  # of MPC

NOT_BY_PLAN = ("mpc", "mpc-value", "trpo", "trpo-alone")
"""Methods whose time is not that of a plan: by the instant, or of training."""


def run(setting: Setting, parts: Parts) -> Findings:
    """Times of plans on the four queries, of MPC's instants, of data generation, of training."""
    plans = []
    for contestant in CONTESTANTS:
        row = on_the_four_queries(contestant, parts, skipped(contestant, setting))
        known = [s for s in row["seconds"] if s is not None]
        cpu = [s for s in row["cpu_seconds"] if s is not None]
        plans.append(
            {
                "key": row["key"],
                "label": row["label"],
                "paper_row": row["paper_row"],
                "absent": row["absent"],
                "seconds": float(np.median(known)) if known else None,
                "cpu_seconds": float(np.median(cpu)) if cpu else None,
            }
        )
    workers = [w for w in WORKERS if not setting.quick or w <= 2]
    repeats = 2 if setting.quick else 8
    document = {
        "plans": plans,
        "mpc": parts.get("mpc-instants", {"instants": INSTANTS}, _mpc_instants),
        "generation": [
            parts.get(
                f"generation-{w}",
                {"workers": w, "repeats": repeats},
                lambda w=w: _generation(w, repeats, setting.seed),
            )
            for w in workers
        ],
        "training": _training(),
    }
    return Findings(document, {"table2": sheet(document)})


def _mpc_instants() -> dict[str, float]:
    """Processor's seconds of an instant: the first of each query, and the warm ones that follow."""
    cold, warm = [], []
    for goal in GOALS:
        value = receding_horizon(paper_query(goal)).value
        value.motion(np.array([0.0, -3.0, 0.4]))  # the program is built once
        state = np.array(PAPER_START)
        for k in range(INSTANTS):
            begun = time.process_time()
            motion = value.motion(state)
            (warm if k else cold).append(time.process_time() - begun)
            state = motion.states[1].copy()
    return {
        "cold": float(np.median(cold)),
        "warm": float(np.median(warm)),
        "warm_95": float(np.quantile(warm, 0.95)),
        "warm_largest": float(np.max(warm)),
    }


def _generation(workers: int, repeats: int, seed: int) -> dict[str, Any]:
    """Wall seconds of eight exact trajectories, median over queries; workers are warm."""
    rng = np.random.default_rng([seed, 2])
    times, failed = [], 0
    with open_door(workers, preload=PRELOAD) as door:
        for k in range(repeats + 1):
            query = paper_query(GOALS[k % len(GOALS)])
            starts = [sample_start(query, rng) for _ in range(TRAJECTORIES)]
            took, lost = generated(door, query, starts)
            if k:  # the first loads compiled code
                times.append(took)
                failed += lost
    return {
        "workers": workers,
        "seconds": float(np.median(times)),
        "trajectories": TRAJECTORIES,
        "failed": failed,
    }


def _training() -> dict[str, float | None]:
    """Seconds of training, from the records in the shipped weights."""
    from learning.trpo.policy import TRAINED, TRAINED_ALONE, TrpoWeights

    return {
        key: TrpoWeights.load(path).provenance["last"]["seconds"] if path.is_file() else None
        for key, path in (("trpo", TRAINED), ("trpo-alone", TRAINED_ALONE))
    }


def sheet(document: dict[str, Any]) -> Sheet:
    """Ours beside the paper's."""
    result = Sheet(
        "Table II: time of every component",
        ("component", "wall clock", "processor", "the paper"),
    )
    for row in document["plans"]:
        if row["key"] in NOT_BY_PLAN:
            continue
        claim = TABLE_II.get(row["paper_row"] or "")
        missing = ABSENT if row["absent"] else "-"
        result.add(
            row["label"],
            seconds(row["seconds"], missing),
            seconds(row["cpu_seconds"], missing),
            seconds(claim),
        )
    mpc = document["mpc"]
    result.add("MPC, an instant, warm", "-", seconds(mpc["warm"]), seconds(TABLE_II["MPC"]))
    result.add("MPC, an instant, warm, largest", "-", seconds(mpc["warm_largest"]), "-")
    result.add("MPC, the first instant", "-", seconds(mpc["cold"]), "-")
    trpo = document["training"]["trpo"]
    alone = document["training"]["trpo-alone"]
    result.add("TRPO, training for the family", seconds(trpo, ABSENT), "-", "-")
    result.add("TRPO, for one query", seconds(alone, ABSENT), "-", seconds(TABLE_II["TRPO"]))
    claims = {
        1: TABLE_II["Anytime adaptation, data generation (n = 8)"],
        4: TABLE_II["Anytime adaptation, data generation (4 processes)"],
    }
    for row in document["generation"]:
        plural = "" if row["workers"] == 1 else "s"
        result.add(
            f"Adaptation, data generation, n = 8, {row['workers']} worker{plural}",
            seconds(row["seconds"]),
            "-",
            seconds(claims.get(row["workers"])),
        )
    result.notes = [
        "Plans: median over the four queries, from the query in memory to the policy ready.",
        "Data generation: eight exact trajectories from random starts by warm workers.",
    ]
    return result


def draw(document: dict[str, Any], out: Path) -> list[Path]:
    """Bars on a logarithmic axis: ours, and the paper's."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save_all

    rows: list[tuple[str, float, float | None]] = [
        (row["label"], row["seconds"], TABLE_II.get(row["paper_row"] or ""))
        for row in document["plans"]
        if row["seconds"] is not None and row["key"] not in NOT_BY_PLAN
    ]
    rows.append(("MPC, an instant", document["mpc"]["warm"], TABLE_II["MPC"]))
    one = document["generation"][0]
    claim = TABLE_II["Anytime adaptation, data generation (n = 8)"]
    rows.append(("Adaptation, 8 trajectories", one["seconds"], claim))
    figure, axes = plt.subplots(figsize=(7.2, 0.42 * len(rows) + 1.4), layout="constrained")
    for i, (_, ours, paper) in enumerate(rows):
        axes.plot(ours, -i, "o", color="#0072B2", ms=7, label="ours" if i == 0 else None)
        if paper is not None:
            shown = None if any(r[2] for r in rows[:i]) else "the paper"
            axes.plot(paper, -i, "D", mfc="none", mec="#D55E00", ms=7, label=shown)
            axes.plot([ours, paper], [-i, -i], color="0.8", lw=1, zorder=0)
    labels = [label.replace(" (", "\n(", 1) for label, *_ in rows]
    axes.set_yticks([-i for i in range(len(rows))], labels)
    axes.set_xscale("log")
    axes.set_xlabel("time (s)")
    axes.grid(axis="x", alpha=0.3)
    axes.tick_params(axis="y", length=0)
    axes.legend(frameon=False, loc="center right")
    return save_all(figure, out / "table2")


def entries(document: dict[str, Any]) -> list[Entry]:
    """One for each time of the table."""
    found = []
    by_row = {r["paper_row"]: r for r in document["plans"] if r["paper_row"]}
    for name in TABLE_II:
        if name in by_row and name not in ("MPC", "TRPO"):
            row = by_row[name]
            ours = seconds(row["seconds"], ABSENT)
            remark = row["absent"] or _faster(TABLE_II[name], row["seconds"])
            found.append(
                Entry(f"Table II, {name}", seconds(TABLE_II[name]), ours=ours, remark=remark)
            )
    mpc = document["mpc"]
    found.append(
        Entry(
            "Table II, MPC (each instant)",
            seconds(TABLE_II["MPC"]),
            ours=seconds(mpc["warm"]),
            remark=f"Warm started; {seconds(mpc['warm_largest'])} at most, {seconds(mpc['cold'])} "
            "for the first instant.",
        )
    )
    trpo, alone = document["training"]["trpo"], document["training"]["trpo-alone"]
    found.append(
        Entry(
            "Table II, TRPO",
            seconds(TABLE_II["TRPO"]),
            ours=seconds(alone, ABSENT),
            remark="For goal (1, 1) alone, as the paper trains; one policy for the whole family, "
            f"of as many steps, took {seconds(trpo, ABSENT)} on a loaded machine.",
        )
    )
    for row in document["generation"]:
        names = {
            1: "Anytime adaptation, data generation (n = 8)",
            4: "Anytime adaptation, data generation (4 processes)",
        }
        if row["workers"] in names:
            name = names[row["workers"]]
            recomputed = "4.3 s by Table III" if row["workers"] == 1 else "-"
            remark = "Table II (6.8 s) and Table III (4.3 s) disagree about the same n = 8. "
            remark = remark if row["workers"] == 1 else "With as many cores as this machine has. "
            found.append(
                Entry(
                    f"Table II, {name}",
                    seconds(TABLE_II[name]),
                    recomputed,
                    seconds(row["seconds"]),
                    remark=remark + _faster(TABLE_II[name], row["seconds"]),
                )
            )
    return found


def _faster(claim: float, ours: float | None) -> str:
    if ours is None:
        return ""
    ratio = claim / ours
    if ratio >= 1:
        return f"{ratio:.3g} times faster, on another machine and compiled."
    return f"{1 / ratio:.3g} times slower."
