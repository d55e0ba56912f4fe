"""Parts of an experiment: computed once, anew for another configuration, never half written."""

import json
from pathlib import Path

import pytest

from sims.parts import Parts


class Counter:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, int]:
        self.calls += 1
        return {"calls": self.calls}


def test_a_finished_part_is_not_computed_again(tmp_path: Path) -> None:
    work = Counter()
    for _ in range(2):
        parts = Parts(tmp_path, {"seed": 0})
        assert parts.get("a", {"size": (3, 4)}, work) == {"calls": 1}


@pytest.mark.parametrize(
    ("common", "config"), [({"seed": 1}, {"size": 3}), ({"seed": 0}, {"size": 4})]
)
def test_another_configuration_is_computed_anew(tmp_path: Path, common, config) -> None:
    work = Counter()
    Parts(tmp_path, {"seed": 0}).get("a", {"size": 3}, work)
    assert Parts(tmp_path, common).get("a", config, work) == {"calls": 2}
    assert Parts(tmp_path, common).get("a", config, work) == {"calls": 2}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"config": {"seed": 0}}'])
def test_a_damaged_part_is_computed_anew(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    assert Parts(tmp_path, {"seed": 0}).get("a", {}, Counter()) == {"calls": 1}
    assert json.loads((tmp_path / "a.json").read_text())["answer"] == {"calls": 1}


def test_a_failed_part_leaves_nothing(tmp_path: Path) -> None:
    def fails() -> None:
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError):
        Parts(tmp_path, {}).get("a", {}, fails)
    with pytest.raises(ValueError, match="JSON compliant"):
        Parts(tmp_path, {}).get("a", {}, lambda: float("nan"))
    assert list(tmp_path.iterdir()) == []
