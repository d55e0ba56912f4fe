"""Values of a TOML file's tables, refused by their names where they make no sense."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def tables_of(table: Mapping[str, Any], key: str) -> list[Any]:
    """The tables of the array `[[key]]`; none if it is absent.

    Raises:
        ValueError: if it is no array.
    """
    entries = table.get(key, [])
    if not isinstance(entries, list):
        raise ValueError(f"{key}: must be an array of tables, [[{key}]]")
    return entries


def refuse_unknown(table: Mapping[str, Any], prefix: str, known: set[str] | frozenset[str]) -> None:
    """Refuse the first key that is not known.

    Raises:
        ValueError: naming it and what is known.
    """
    for key in table:
        if key not in known:
            raise ValueError(f"{prefix}{key}: unknown; known are {', '.join(sorted(known))}")


def table_of(value: Any, name: str, known: set[str] | None) -> Mapping[str, Any]:
    """The value as a table of known keys, or of any if `known` is `None`.

    Raises:
        ValueError: if it is no table, or a key is unknown.
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: must be a table, got {value!r}")
    if known is not None:
        refuse_unknown(value, f"{name}.", known)
    return value


def number_of(value: Any, name: str) -> float:
    """The value as a number; it may be infinite.

    Raises:
        ValueError: if it is none.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise ValueError(f"{name}: must be a number, got {value!r}")
    return float(value)


def positive(value: float, name: str) -> float:
    """The number.

    Raises:
        ValueError: unless it is positive and finite.
    """
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: must be positive and finite, got {value:g}")
    return value


def numbers_of(value: Any, name: str) -> Array:
    """The value as a list `[k]` of finite numbers.

    Raises:
        ValueError: if it is none, or empty.
    """
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{name}: must be a list of numbers, got {value!r}")
    array = np.array([number_of(v, name) for v in value])
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: numbers must be finite, got {value!r}")
    return array


def rows_of(value: Any, name: str) -> Array:
    """The value as rows `[k, l]` of finite numbers.

    Raises:
        ValueError: if it is none, empty or ragged.
    """
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{name}: must be a list of rows of numbers, got {value!r}")
    rows = [numbers_of(row, name) for row in value]
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"{name}: rows must be of equal length, got {value!r}")
    return np.array(rows)
