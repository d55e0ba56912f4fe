"""The rooms of the house: imports point down only, heavy libraries stay where they belong."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("ocp", "learning", "planners", "sims")
MAY_IMPORT = {
    "ocp": {"ocp"},
    "learning": {"learning", "ocp"},
    "planners": {"planners", "ocp"},
    "sims": set(ROOMS),
}
PYDRAKE_ROOMS = ("ocp/models/", "ocp/riccati.py", "ocp/collocation.py", "planners/", "sims/")


def sources(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in the file."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_down_only(room: str) -> None:
    for path in sources(room):
        for name in imported(path):
            top = name.split(".")[0]
            assert top not in ROOMS or top in MAY_IMPORT[room], f"{path} imports {name}"


def test_torch_is_imported_in_learning_alone() -> None:
    for room in ("ocp", "planners", "sims"):
        for path in sources(room):
            assert "torch" not in {n.split(".")[0] for n in imported(path)}, path


def test_pydrake_is_imported_only_at_its_doors() -> None:
    for room in ROOMS:
        for path in sources(room):
            if "pydrake" in {n.split(".")[0] for n in imported(path)}:
                relative = path.relative_to(ROOT).as_posix()
                assert relative.startswith(PYDRAKE_ROOMS), relative


def test_no_circular_imports() -> None:
    """No module reaches itself through imports made at the top of the file."""
    modules = {}
    for room in ROOMS:
        for path in sources(room):
            parts = path.relative_to(ROOT).with_suffix("").parts
            modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    graph = {}
    for name, path in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        targets = set()
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module:
                targets |= {f"{node.module}.{a.name}" for a in node.names} | {node.module}
            elif isinstance(node, ast.Import):
                targets |= {a.name for a in node.names}
        graph[name] = {t for t in targets if t in modules and t != name}

    def visit(node: str, trail: tuple[str, ...]) -> None:
        assert node not in trail, " -> ".join((*trail, node))
        if node in done:
            return
        for target in graph[node]:
            visit(target, (*trail, node))
        done.add(node)

    done: set[str] = set()
    for name in graph:
        visit(name, ())


def test_the_tools_look_at_every_room() -> None:
    """The wheel lists each package folder; the type checker includes each room and the tests."""
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    folders = {
        path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for room in ROOMS
        for path in (ROOT / room).rglob("__init__.py")
    }
    assert set(project["tool"]["setuptools"]["packages"]) == folders
    assert set(project["tool"]["pyright"]["include"]) == {*ROOMS, "tests"}
    assert "exclude" not in project["tool"]["ruff"]
