"""The documentation names things that exist."""

import importlib
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted((ROOT / "docs").rglob("*.md"))
NAME = re.compile(r"`((?:ocp|learning|planners|sims)(?:\.\w+)+)`")
FILE = re.compile(r"`((?:ocp|learning|planners|sims|tests|notebooks|examples)/[\w./-]*[\w/])`")
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")
TABLES = {"meta-value-learning.md": 19, "rrt-qx-equations.md": 26}
"""Theory page, and the last equation of its paper."""


def look_up(name: str) -> Any:
    """The module, function, class or attribute of a dotted name."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError as error:
            if error.name is None or not ".".join(parts[:cut]).startswith(error.name):
                raise
            continue
        for attribute in parts[cut:]:
            found = getattr(found, attribute)
        return found
    raise AssertionError(name)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_names_files_and_links_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    wrong = []
    for name in sorted(set(NAME.findall(text))):
        try:
            look_up(name)
        except (AttributeError, AssertionError):
            wrong.append(name)
    wrong += [name for name in FILE.findall(text) if not (ROOT / name).exists()]
    wrong += [link for link in LINK.findall(text) if not (page.parent / link).exists()]
    assert not wrong


@pytest.mark.parametrize("page", TABLES)
def test_every_equation_has_its_function(page: str) -> None:
    text = (ROOT / "docs" / "theory" / page).read_text(encoding="utf-8")
    told: set[int] = set()
    for row in re.findall(r"^\|([^|]*)\|[^|]*\|([^|]*)\|$", text, re.MULTILINE):
        if NAME.search(row[1]):
            for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", row[0]):
                told |= set(range(int(first), int(last or first) + 1))
    assert set(range(1, TABLES[page] + 1)) <= told


def test_every_page_is_in_the_contents() -> None:
    contents = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    missing = {page.relative_to(ROOT / "docs").as_posix() for page in PAGES} - set(
        re.findall(r": ([\w/-]+\.md)$", contents, re.MULTILINE)
    )
    assert not missing


QUERIES = [
    pytest.param(block, id=f"{page.stem}-{k}")
    for page in PAGES
    for k, block in enumerate(
        re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    )
    if re.search(r"^model = ", block, re.MULTILINE)
]


@pytest.mark.parametrize("text", QUERIES)
def test_query_files_in_the_documentation_load(text: str, tmp_path: Path) -> None:
    from ocp.query import Query

    path = tmp_path / "query.toml"
    path.write_text(text, encoding="utf-8")
    assert Query.load(path).system.n > 0


def test_look_up_refuses_what_is_not_there() -> None:
    with pytest.raises(AttributeError):
        look_up("ocp.query.Qwery")
