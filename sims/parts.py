"""Finished parts of long work, kept so that a run that was stopped goes on where it was."""

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ocp.files import write_text

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parts:
    """Parts as JSON files in a folder, each with the configuration that made it.

    Attributes:
        folder: where they are; `None` keeps nothing.
        common: configuration of all parts, such as seed and version of the code.
    """

    folder: Path | None
    common: dict[str, Any]

    def get(self, name: str, config: dict[str, Any], compute: Callable[[], Any]) -> Any:
        """What `compute` returned for this configuration, now or in an earlier run.

        A part is stored whole or not at all. One that was made with another configuration, or whose
        file is damaged, is computed anew.

        Args:
            name: of the part, unique in the folder, fit for a file's name.
            config: what the answer depends on, beside `common`.
            compute: returns plain data for JSON.
        """
        if self.folder is None:
            return compute()
        wanted = json.loads(json.dumps({**self.common, **config}))
        path = self.folder / f"{name}.json"
        if path.is_file():
            try:
                kept = json.loads(path.read_text(encoding="utf-8"))
                if kept["config"] == wanted:
                    return kept["answer"]
                log.info("%s: made with another configuration, computed anew", name)
            except (ValueError, KeyError, TypeError):
                log.warning("%s: damaged, computed anew", path)
        log.info("%s", name)
        answer = compute()
        text = json.dumps({"config": wanted, "answer": answer}, allow_nan=False)
        write_text(path, text)
        return json.loads(text)["answer"]
