"""Coverage-guided fuzzing of the files that zermelo reads; needs atheris, which is not installed
with the rest: `pip install atheris`, then `python tests/fuzz_with_coverage.py -max_total_time=600`.

Any bytes are taken, or refused by a ValueError with a message (`OSError` for a robot's file that is
not there). Anything else is a finding: libFuzzer stops there and keeps the bytes. Options and the
folder of a corpus are libFuzzer's own.
"""

import sys
import tomllib
from pathlib import Path

import atheris  # pyright: ignore[reportMissingImports]

with atheris.instrument_imports(  # pyright: ignore[reportAttributeAccessIssue]
    include=["ocp.query", "ocp.query_file", "ocp.obstacle", "sims"]
):
    from ocp.query_file import query_from_dict, query_to_dict
    from sims.navigation.scenario_file import Scenario
    from sims.regulation.system_file import SystemFile


def take(data: bytes) -> None:
    """One input: the first byte chooses the door."""
    if not data:
        return
    try:
        table = tomllib.loads(data[1:].decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError):
        return
    try:
        if data[0] % 3 == 0:
            query = query_from_dict(table)
            assert query_from_dict(query_to_dict(query)) == query
        elif data[0] % 3 == 1:
            SystemFile.from_dict(table)
        else:
            Scenario.from_dict(table)
    except (ValueError, OSError) as error:
        if not str(error):
            raise


def corpus(folder: Path) -> None:
    """The files that are shipped, as a beginning."""
    root = Path(__file__).resolve().parents[1]
    for door, inner in enumerate(("queries", "systems", "scenarios")):
        for path in (root / "sims" / inner).glob("*.toml"):
            (folder / f"{inner}-{path.stem}").write_bytes(bytes([door]) + path.read_bytes())


def main() -> None:
    """libFuzzer's loop, from the shipped files unless a corpus is named."""
    import tempfile

    with tempfile.TemporaryDirectory() as made:
        corpus(Path(made))
        atheris.Setup([*sys.argv, made], take)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
