"""Every scripted demo runs, says that it succeeded, and leaves a picture."""

import json
from pathlib import Path

import pytest

from sims.demos import DEMOS, run_demo

PICTURES = {".png", ".gif", ".html"}


@pytest.mark.notebook
@pytest.mark.parametrize("name", DEMOS)
def test_it_runs_and_leaves_a_picture(name: str, tmp_path: Path) -> None:
    shown = run_demo(name, 0, tmp_path)
    assert shown.succeeded
    assert shown.tables
    json.dumps(shown.document, allow_nan=False)
    written = [path for path in tmp_path.iterdir() if path.suffix in PICTURES]
    assert any(path.suffix == ".png" and path.stat().st_size > 10_000 for path in written)


def test_each_file_has_its_name_and_each_name_its_file() -> None:
    folder = Path(__file__).resolve().parent.parent / "sims" / "demos"
    files = {path.stem.replace("_", "-") for path in folder.glob("*.py")} - {"--init--"}
    assert files == set(DEMOS)
