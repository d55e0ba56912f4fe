"""The soak's own machinery: it counts kills, and it would notice a run that ends differently."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from sims.benchmarks.soak import killed_runs, main, without_times

WORK = """
import json, pathlib, sys, time
folder, honest = pathlib.Path(sys.argv[1]), sys.argv[2] == "True"
state = folder / "state.json"
found = json.loads(state.read_text()) if state.exists() else {"steps": 0, "runs": 0}
found["runs"] += 1
while found["steps"] < 20:
    found["steps"] += 1
    other = folder / "state.tmp"
    other.write_text(json.dumps(found))
    other.replace(state)
    time.sleep(0.02)
text = json.dumps({"steps": found["steps"], "runs": 1 if honest else found["runs"]})
(folder / "result.json").write_text(text)
"""


def result(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


@pytest.mark.parametrize("honest", [True, False], ids=["goes on", "remembers that it was killed"])
def test_a_run_that_ends_differently_after_kills_is_found(tmp_path: Path, honest: bool) -> None:
    def command(folder: Path) -> list[str]:
        return [sys.executable, "-c", WORK, str(folder), str(honest)]

    found = killed_runs(command, result, 4, 1, tmp_path)
    assert found.kills == 4
    assert found.gone_on <= 4
    assert found.failed == 0
    assert found.completed >= 1
    # A kill that met traces of work is remembered by the dishonest run, which then ends otherwise.
    assert (found.unequal > 0) == (not honest and found.gone_on > 0)


def test_a_command_that_fails_is_no_soak(tmp_path: Path) -> None:
    def command(_folder: Path) -> list[str]:
        return [sys.executable, "-c", "raise SystemExit('broken')"]

    with pytest.raises(RuntimeError, match="broken"):
        killed_runs(command, result, 3, 0, tmp_path)


def test_times_are_left_out_at_any_depth() -> None:
    document = {"cost": 1.0, "loops": [{"reaction_time_s": 2.0, "cost": 3.0}], "seconds": 4.0}
    assert without_times(document) == {"cost": 1.0, "loops": [{"cost": 3.0}]}


def test_a_count_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["kills", "--count", "0"])
    assert caught.value.code == 2
    assert "count: must be at least 3" in capsys.readouterr().err
