"""The documented API says what it takes, what it returns and what it refuses.

Documented are the modules on the pages of docs/api. Of each public class and function there: it has
a docstring; one that takes or returns arrays gives shapes in backticks (its own, or its class's);
one that raises ValueError or SolveError says so.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted(
    name
    for page in (ROOT / "docs" / "api").glob("*.md")
    for name in re.findall(r"^::: ([\w.]+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
)
ARRAY = re.compile(r"\b(ArrayLike|NDArray|Array|Floats|Ints)\b")
SHAPE = re.compile(r"`\[[^`]*\]`|`[a-z]`")
SAYS_SO = re.compile(r"[Rr]aise|[Rr]efuse")
REFUSALS = {"ValueError", "SolveError"}


def source(module: str) -> ast.Module:
    path = ROOT / module.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8"))


def public(body: list[ast.stmt]) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node


def functions(module: str) -> Iterator[tuple[ast.FunctionDef, str, str]]:
    """Each public function or method with its name and the docstring around it."""
    for node in public(source(module).body):
        if isinstance(node, ast.FunctionDef):
            yield node, node.name, ""
            continue
        around = ast.get_docstring(node) or ""
        for method in public(node.body):
            if isinstance(method, ast.FunctionDef):
                yield method, f"{node.name}.{method.name}", around


def raised(function: ast.FunctionDef) -> set[str]:
    return {
        node.exc.func.id
        for node in ast.walk(function)
        if isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and isinstance(node.exc.func, ast.Name)
    }


def is_command(function: ast.FunctionDef) -> bool:
    """A command of the command line turns what it raises into an exit status."""
    return any(argument.arg == "command" for argument in function.args.args)


@pytest.mark.parametrize("module", MODULES)
def test_classes_and_functions_have_docstrings(module: str) -> None:
    bare = [node.name for node in public(source(module).body) if not ast.get_docstring(node)]
    assert not bare


@pytest.mark.parametrize("module", MODULES)
def test_arrays_have_shapes(module: str) -> None:
    missing = []
    for function, name, around in functions(module):
        text = ast.get_docstring(function)
        kinds = [a.annotation for a in (*function.args.args, *function.args.kwonlyargs)]
        written = " ".join(ast.unparse(k) for k in (*kinds, function.returns) if k)
        if text and ARRAY.search(written) and not SHAPE.search(text + around):
            missing.append(name)
    assert not missing


@pytest.mark.parametrize("module", MODULES)
def test_refusals_are_announced(module: str) -> None:
    silent = [
        name
        for function, name, _ in functions(module)
        if raised(function) & REFUSALS
        and not is_command(function)
        and not SAYS_SO.search(ast.get_docstring(function) or "")
    ]
    assert not silent
