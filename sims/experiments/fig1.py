"""Figure 1: trajectories from the paper's six starts on the four queries, the optimum beside."""

from pathlib import Path
from typing import Any

import numpy as np

from ocp.query_family import PAPER_FIGURE_STARTS, PAPER_GOALS, paper_query
from ocp.trajectory import Status, Trajectory
from sims.closed_loop import Rollout
from sims.experiments import Entry, Findings, Setting
from sims.experiments.contestants import CONTESTANTS, contestant
from sims.experiments.measure import judged, truth
from sims.experiments.sheet import Sheet, number, percent
from sims.parts import Parts

"""In the order of the figure's panels."""
PREFERRED = ("adapt", "eikonal")
PAPERS = ("faithful", "anytime")


def run(setting: Setting, parts: Parts) -> Findings:
    """The paper's own planner, where its weights are there, and ours."""
    ours = next(key for key in PREFERRED if contestant(key).absent is None)
    figures = {}
    for key in (ours, *PAPERS):
        if contestant(key).absent is None:
            figures[key] = [_panel(key, goal, parts, setting) for goal in PAPER_GOALS]
    document = {
        "ours": ours,
        "absent": {c.key: c.absent for c in CONTESTANTS if c.key in PAPERS and c.absent},
        "figures": figures,
    }
    return Findings(document, {"fig1": sheet(document)})


def _panel(key: str, goal: tuple[float, float], parts: Parts, setting: Setting) -> dict[str, Any]:
    query, who = paper_query(goal), contestant(key)
    starts = PAPER_FIGURE_STARTS[::2] if setting.quick else PAPER_FIGURE_STARTS
    tag = "{:g}-{:g}".format(*goal)
    optima = [
        truth(parts, query, s, f"truth-{tag}-start-{PAPER_FIGURE_STARTS.index(s)}") for s in starts
    ]
    found = parts.get(
        f"fig1-{key}-{tag}",
        {**who.config, "starts": [list(s) for s in starts]},
        lambda: judged(who, query, starts, with_path=True),
    )
    return {
        "goal": list(goal),
        "starts": [list(s) for s in starts],
        "optima": optima,
        "loops": found["loops"],
        "failure": found["failure"],
    }


def sheet(document: dict[str, Any]) -> Sheet:
    """Costs and collisions of every trajectory."""
    result = Sheet(
        "Figure 1: closed loops from the paper's six starts",
        ("planner, goal, start", "cost", "optimum", "excess", "collided", "optimum collides"),
    )
    for key, panels in document["figures"].items():
        for panel in panels:
            query = paper_query(tuple(panel["goal"]))
            loops = panel["loops"] or [None] * len(panel["starts"])
            for start, optimum, loop in zip(panel["starts"], panel["optima"], loops, strict=True):
                name = "{}, ({:g}, {:g}), ({:g}, {:g}, {:.3g})".format(key, *panel["goal"], *start)
                cost = None if loop is None else loop["cost"]
                least = optimum["cost"]
                excess = None if cost is None or least is None else cost / least - 1
                clips = optimum["path"] and query.clearance(optimum["path"]).min() < 0
                result.add(
                    name,
                    number(cost, "{:.3f}", "not reached"),
                    number(least, "{:.3f}"),
                    percent(excess),
                    "-" if loop is None else ("yes" if loop["collided"] else "no"),
                    "yes" if clips else "no",
                )
    return result


def draw(document: dict[str, Any], out: Path) -> list[Path]:
    """Four panels for each planner, as the paper's figure."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import draw_plan, legend, save_all

    written = []
    for key, panels in document["figures"].items():
        if not any(panel["loops"] for panel in panels):
            continue  # the table says why
        figure, axes = plt.subplots(2, 2, figsize=(8.6, 9.0), layout="constrained")
        for axis, panel, tag in zip(axes.flat, panels, "abcd", strict=True):
            query = paper_query(tuple(panel["goal"]))
            loops = [
                Rollout(query, _motion(loop["path"]), loop["reached"], np.inf)
                for loop in panel["loops"] or []
            ]
            optima = [_motion(o["path"]) if o["path"] else None for o in panel["optima"]]
            draw_plan(axis, query, loops, optima)
            axis.set_title("({}) goal ({:g}, {:g})".format(tag, *panel["goal"]))
        legend(figure)
        name = "fig1" if key == document["ours"] else f"fig1-{key}"
        written += save_all(figure, out / name)
    return written


def _motion(path: list[list[float]]) -> Trajectory:
    """A stored path as a motion without times, for drawing."""
    states = np.array(path)
    blank = np.arange(len(states), dtype=float)
    return Trajectory(blank, states, np.zeros((len(states), 2)), None, blank, Status.SOLVED)


def entries(document: dict[str, Any]) -> list[Entry]:
    """What the text says about the figure."""
    panels = document["figures"][document["ours"]]
    loops = [loop for p in panels for loop in p["loops"] or []]
    collided = sum(loop["collided"] for loop in loops)
    clips = 0
    for panel in panels:
        query = paper_query(tuple(panel["goal"]))
        clips += sum(
            bool(query.clearance(o["path"]).min() < 0) for o in panel["optima"] if o["path"]
        )
    return [
        Entry(
            "Section IV-D, Figure 1: collisions are avoided",
            "all avoided",
            ours=f"{collided} of {len(loops)} closed loops of {document['ours']} enter an obstacle",
            optimum=f"{clips} of the exact optima do",
            remark="The obstacles are soft costs: where the optimum cuts a corner, so does a "
            "nearly optimal policy.",
        )
    ]
