"""The digest of sources: it covers all that a module may import, and nothing else."""

import ast

import pytest

from ocp.version import ROOT, _file, _imported, code_version

FILES = sorted(ROOT.rglob("*.py"))


def test_it_is_stable_and_tells_modules_apart() -> None:
    assert code_version("ocp.eikonal") == code_version("ocp.eikonal")
    assert len({code_version(), code_version("ocp.eikonal"), code_version("ocp.oracle")}) == 3


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_import_is_missed(path) -> None:
    """The parser's list of a file's imports of ocp, as files, against the digest's."""
    expected = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            expected |= {_file(alias.name) for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            expected |= {_file(node.module)}
            expected |= {_file(f"{node.module}.{alias.name}") for alias in node.names}
    found = {_file(name) for name in _imported(path)}
    assert expected - {None} <= found


def test_a_module_that_is_none_is_refused() -> None:
    for name in ("ocp.magic", "numpy", "learning"):
        with pytest.raises(ValueError, match=name):
            code_version(name)
