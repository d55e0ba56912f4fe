"""Settings of a training run: a frozen dataclass, read from a table of TOML and refused if unfit.

Unknown keys are refused, so that a misspelt parameter cannot silently keep its default.
"""

from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, get_type_hints

Settings = TypeVar("Settings")


def from_table(kind: type[Settings], table: Any, owner: str = "") -> Settings:
    """A dataclass, and those in its fields, from a parsed table.

    Args:
        kind: the dataclass; its fields are booleans, numbers, words, enums, tuples of whole numbers
            or dataclasses.
        table: what the file says.
        owner: what goes before a field's name in messages, such as "data.".

    Raises:
        ValueError: naming the field, its value and what would be right.
    """
    if not isinstance(table, dict):
        raise ValueError(f"{owner.rstrip('.') or 'settings'}: must be a table, got {table!r}")
    hints = get_type_hints(kind)
    known = {f.name: f for f in fields(kind)}  # pyright: ignore[reportArgumentType]
    for name in table:
        if name not in known:
            raise ValueError(f"{owner}{name}: unknown; known are {', '.join(known)}")
    found = {name: _converted(hints[name], value, owner + name) for name, value in table.items()}
    for name, f in known.items():
        if name not in table and f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"{owner}{name}: missing")
    return kind(**found)


def _converted(kind: Any, value: Any, field: str) -> Any:
    if is_dataclass(kind):
        return from_table(kind, value, f"{field}.")  # pyright: ignore[reportArgumentType]
    if isinstance(kind, type) and issubclass(kind, Enum):
        members = {word_of(member): member for member in kind}
        if value not in members:
            raise ValueError(f"{field}: must be one of {', '.join(members)}, got {value!r}")
        return members[value]
    if kind == tuple[int, ...]:
        if not isinstance(value, list | tuple) or not all(type(x) is int and x > 0 for x in value):
            raise ValueError(f"{field}: must be a list of positive whole numbers, got {value!r}")
        return tuple(value)
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{field}: must be {WORDS[kind]}, got {value!r}")
    return value


WORDS = {int: "a whole number", float: "a number", str: "a word", bool: "true or false"}


def word_of(member: Enum) -> str:
    """What a file calls an enum's member: its value, or its name where the value is a sentence."""
    return member.name.lower() if " " in str(member.value) else str(member.value)
