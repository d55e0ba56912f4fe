"""Homotopy classes: from one start several extremals, each locally optimal; one is the optimum."""

from pathlib import Path

from rich.table import Table

from ocp.obstacle import Obstacle
from ocp.pontryagin import exact_trajectories
from ocp.query import Goal, Query
from ocp.trajectory import Trajectory
from sims.demos import Demonstration

QUERY = Query(
    "unicycle",
    Goal((3.5, 3.0), 0.5),
    (
        Obstacle.circle((-0.8, -0.6), 1.2),
        Obstacle.diamond((1.6, 1.6), 0.9),
        Obstacle.circle((2.6, -1.2), 0.8),
    ),
)
STARTS = ((-4.0, -4.0, -0.785), (2.5, -3.5, 1.6))
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#5B3A9E", "#6B6B6B")


def run(_seed: int, out: Path | None) -> Demonstration:
    """All extremals found from two starts, the cheapest first."""
    found = {start: exact_trajectories(QUERY, start) for start in STARTS}
    table = Table(title="locally optimal motions, by cost")
    for column in ("start", "cost", "over the least", "duration", "clearance"):
        table.add_column(column, justify="left" if column == "start" else "right")
    document = []
    for start, motions in found.items():
        least = motions[0].cost
        for k, motion in enumerate(motions):
            clearance = float(QUERY.clearance(motion.states).min())
            table.add_row(
                "({:g}, {:g}, {:g})".format(*start) if k == 0 else "",
                f"{motion.cost:.4f}",
                f"{motion.cost / least - 1:.2%}",
                f"{motion.duration:.2f} s",
                f"{clearance:.2f} m",
            )
        document.append({"start": list(start), "costs": [m.cost for m in motions]})
    if out is not None:
        _figure(found, out)
    succeeded = all(len(motions) > 1 for motions in found.values())
    return Demonstration({"starts": document}, [table], succeeded)


def _figure(found: dict[tuple[float, float, float], list[Trajectory]], out: Path) -> None:
    import matplotlib.pyplot as plt

    from ocp.eikonal import solve_eikonal
    from sims.pictures.plan_figure import draw_plan, save

    value = solve_eikonal(QUERY).value
    figure, axes = plt.subplots(
        1, len(found), figsize=(6.4 * len(found), 5.6), layout="constrained"
    )
    for panel, (start, motions) in zip(axes, found.items(), strict=True):
        draw_plan(panel, QUERY, [], [], value)
        shown = motions[: len(COLOURS)]
        for colour, motion in reversed(list(zip(COLOURS, shown, strict=False))):
            p = QUERY.position(motion.states)
            width = 3.0 if motion is motions[0] else 1.6
            panel.plot(*p.T, color=colour, lw=width, label=f"{motion.cost:.3f}", zorder=5)
        panel.plot(*start[:2], "o", color="white", mec="black", ms=7, zorder=7)
        handles, labels = panel.get_legend_handles_labels()
        panel.legend(handles[::-1], labels[::-1], title="cost", fontsize=8, loc="upper left")
        panel.set_title(f"{len(motions)} locally optimal motions")
    save(figure, out / "exact-classes.png")
