"""The second paper's figure (RRT-Q^X, Figure 2): `zermelo navigate` on its scenario."""

import shutil
from pathlib import Path
from typing import Any

from sims.experiments import Entry, Findings, Setting
from sims.experiments.sheet import Sheet, number
from sims.parts import Parts

SCENARIO = Path(__file__).resolve().parents[1] / "scenarios" / "figure-2.toml"
CONTROLLERS = ("q-learning", "riccati")
PICTURES = "rrtqx-fig2"


def run(setting: Setting, parts: Parts) -> Findings:
    """Each controller drives once; the first one's pictures are kept beside its part."""
    controllers = CONTROLLERS[:1] if setting.quick else CONTROLLERS
    folder = (parts.folder or setting.out) / PICTURES
    reports = {}
    for name in controllers:
        pictures = folder if name == CONTROLLERS[0] else None
        config = {"scenario": SCENARIO.read_text(encoding="utf-8")}
        part = f"rrtqx-fig2-{name}"
        reports[name] = parts.get(part, config, lambda n=name, p=pictures: _one(n, setting, p))
    document = {"reports": reports, "pictures": str(folder)}
    return Findings(document, {"rrtqx-fig2": sheet(document)})


def _one(controller: str, setting: Setting, pictures: Path | None) -> dict[str, Any]:
    from sims.navigation import navigate
    from sims.navigation.figure import save_pictures
    from sims.navigation.scenario_file import Scenario

    scenario = Scenario.load(SCENARIO)
    runs = navigate.run(scenario, controller, setting.seed, record=pictures is not None)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        save_pictures(scenario, runs, pictures)
    return navigate.document(runs)


def sheet(document: dict[str, Any]) -> Sheet:
    """What became of each controller's robot."""
    result = Sheet(
        "RRT-Q^X, Figure 2: one robot among obstacles that it discovers",
        (
            "controller",
            "reached",
            "collided",
            "duration, s",
            "length, m",
            "clearance, m",
            "replans",
        ),
    )
    for name, report in document["reports"].items():
        result.add(
            name,
            "yes" if report["reached"] else "no",
            "yes" if report["collided"] else "no",
            number(report["duration_s"], "{:.1f}"),
            number(report["length_m"], "{:.1f}"),
            number(report["min_clearance_m"], "{:.3f}"),
            str(len(report["replans"])),
        )
    return result


def draw(document: dict[str, Any], out: Path) -> list[Path]:
    """The pictures that `zermelo navigate` makes, under this experiment's name."""
    found = sorted(p for p in Path(document["pictures"]).glob("*") if p.suffix in (".png", ".svg"))
    copies = []
    for path in found:
        copies.append(out / f"rrtqx-fig2-{path.name}")
        shutil.copyfile(path, copies[-1])
    return copies


def entries(document: dict[str, Any]) -> list[Entry]:
    """What the paper's figure shows."""
    report = document["reports"][CONTROLLERS[0]]
    outcome = "reaches the goal" if report["reached"] else "does not reach the goal"
    safe = "without collision" if not report["collided"] else "with a collision"
    return [
        Entry(
            "RRT-Q^X, Figure 2: the robot reaches the goal without collision",
            "reached, no collision",
            ours=f"{outcome}, {safe}",
            remark="With the law of Q-learning that converges; the printed law diverges.",
        )
    ]
