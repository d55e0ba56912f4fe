# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # RRT-Q^X in a changing world
#
# A robot whose dynamics nobody told it learns to drive in its first seconds, then crosses a field
# where obstacles come into view eight metres away. The exact Riccati controller drives the same
# field beside it; Drake judges collisions at every integration step.

# %%
import logging
import tempfile
from importlib import resources
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML, display

from sims.navigation.figure import draw_frames
from sims.navigation.navigate import run
from sims.navigation.replay import save_replay
from sims.navigation.scenario_file import Scenario
from sims.navigation.study import cost_excess

logging.getLogger("drake").setLevel(logging.WARNING)
scenario = Scenario.load(str(resources.files("sims") / "scenarios" / "figure-2.toml"))
runs = {
    controller: run(scenario, controller, 0, record=controller == "q-learning")
    for controller in ("q-learning", "riccati")
}

# %%
print("controller    reached  collided  seconds  metres  clearance  deviation  latency, median")
for controller, (drive,) in runs.items():
    clearance = "-" if drive.min_clearance is None else f"{drive.min_clearance:.2f} m"
    print(
        f"{controller:12s}  {drive.reached!s:7s}  {drive.collided!s:8s}  {drive.duration:7.2f}"
        f"  {drive.length:6.2f}  {clearance:>9s}  {drive.navigator.largest_deviation:7.3f} m"
        f"  {1e3 * float(np.median(drive.latencies)):8.1f} ms"
    )
(learned,), (exact,) = runs["q-learning"], runs["riccati"]
print("learned over exact Riccati, relative")
print(f"  length of the way       {learned.length / exact.length - 1:+.1e}")
print(f"  time under way          {learned.duration / exact.duration - 1:+.1e}")
print(f"  cost of following legs  {cost_excess(learned):+.1e}  (same legs, exact gain)")
assert all(drive.reached and not drive.collided for (drive,) in runs.values())

# %% [markdown]
# The learner's run: tree, route, cost-to-go, what it had seen, the padding it had earned.

# %%
figure = draw_frames(scenario, runs["q-learning"][0])
plt.show()

# %% [markdown]
# The same as a Meshcat replay: it plays in the page, and turns with the mouse.

# %%
with tempfile.TemporaryDirectory() as folder:
    page = Path(folder) / "replay.html"
    save_replay(scenario, runs["q-learning"], page)
    source = page.read_text(encoding="utf-8").replace("&", "&amp;").replace('"', "&quot;")
display(HTML(f'<div><iframe srcdoc="{source}" width="100%" height="480"></iframe></div>'))
