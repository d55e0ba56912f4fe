"""Types of translated kernels, and how C writes them."""

import math
from dataclasses import dataclass
from typing import Any

from numba import types

SCALARS = {"f8": "double", "f4": "float", "i8": "long long", "b1": "int"}
ARRAYS = {"f8": "doubles", "f4": "floats", "i8": "integers"}
KEYWORDS = {
    "auto", "case", "char", "const", "default", "do", "double", "enum", "extern", "float", "goto",
    "inline", "int", "long", "register", "restrict", "short", "signed", "sizeof", "static",
    "struct", "switch", "typedef", "union", "unsigned", "void", "volatile",
}  # fmt: skip


class UntranslatableError(ValueError):
    """A kernel holds something that has no translation."""


@dataclass(frozen=True)
class Type:
    """Of an expression: a scalar (`axes` 0), an array, a tuple (`parts`) or a function."""

    base: str
    axes: int = 0
    parts: tuple["Type", ...] = ()
    signature: Any = None

    @property
    def c(self) -> str:
        """Its name in C."""
        if self.base == "void":
            return "void"
        if self.base == "tuple":
            return "tuple_" + "".join(p.base for p in self.parts)
        return ARRAYS[self.base] if self.axes else SCALARS[self.base]


def type_of(numba_type: Any) -> Type:
    """Raises `UntranslatableError` for one that the kernels do not use."""
    if isinstance(numba_type, types.Array):
        return Type(type_of(numba_type.dtype).base, numba_type.ndim)
    if isinstance(numba_type, types.FunctionType):
        return Type("function", signature=numba_type.signature)
    if isinstance(numba_type, types.UniTuple | types.Tuple):
        return Type("tuple", parts=tuple(type_of(t) for t in numba_type.types))
    if isinstance(numba_type, types.Boolean):
        return Type("b1")
    if isinstance(numba_type, types.Integer):
        return Type("i8")
    if isinstance(numba_type, types.Float):
        return Type("f4" if numba_type.bitwidth == 32 else "f8")
    if isinstance(numba_type, types.NoneType):
        return Type("void")
    raise UntranslatableError(f"type {numba_type}")


def number(value: Any) -> tuple[str, Type]:
    if isinstance(value, bool):
        return str(int(value)), Type("b1")
    if isinstance(value, int):
        return str(value), Type("i8")
    if math.isnan(value):
        return "NAN", Type("f8")
    if math.isinf(value):
        return infinite(value), Type("f8")
    return repr(float(value)), Type("f8")


def joined(a: Type, b: Type) -> Type:
    order = ["b1", "i8", "f4", "f8"]
    if {a.base, b.base} == {"i8", "f4"}:
        return Type("f8")
    return Type(max((a.base, b.base, "i8"), key=order.index))


def c_name(name: str) -> str:
    return name + "_" if name in KEYWORDS else name


def declared(kind: Type, name: str) -> str:
    """A declaration of `name`."""
    if kind.base != "function":
        return f"{kind.c} {name}"
    arguments = ", ".join(type_of(a).c for a in kind.signature.args)
    return f"{type_of(kind.signature.return_type).c} (*{name})({arguments})"


def infinite(x: float) -> str:
    return "INFINITY" if x > 0 else "-INFINITY"
