"""Which code made a number: a digest of the sources that can have changed it."""

import hashlib
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent
IMPORT = re.compile(
    r"^[ \t]*(?:from|import)[ \t]+(ocp[.\w]*)(?:[ \t]+import[ \t]+(\([^)]*\)|[^\n]*))?",
    re.MULTILINE,
)


@cache
def code_version(module: str | None = None) -> str:
    """Digest of `module` (such as "ocp.eikonal") and of every module of `ocp` that it may import.

    Imports inside functions count; libraries do not. Without a module, of all of `ocp`.

    Raises:
        ValueError: if there is no such module.
    """
    if module is None:
        files = sorted(ROOT.rglob("*.py"))
    else:
        if (first := _file(module)) is None:
            raise ValueError(f"module: {module!r} is no module of ocp")
        found, waiting = {first}, [first]
        while waiting:
            new = {f for name in _imported(waiting.pop()) if (f := _file(name))} - found
            found |= new
            waiting += new
        files = sorted(found)
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0")
        digest.update(path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _file(name: str) -> Path | None:
    """The source of a module of ocp, or `None` if the name is none."""
    head, *rest = name.split(".")
    if head != ROOT.name:
        return None
    base = ROOT.joinpath(*rest)
    return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)


def _imported(path: Path) -> set[str]:
    """Names of ocp that a file may import, from the text: parsing all sources takes too long."""
    names: set[str] = set()
    for module, imported in IMPORT.findall(path.read_text(encoding="utf-8")):
        names.add(module)
        names |= {f"{module}.{name}" for name in re.findall(r"\w+", imported)}
    return names
