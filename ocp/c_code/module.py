"""A C file that grows by every kernel that is asked for, with all that it calls."""

import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ocp.c_code.types import ARRAYS, SCALARS, Type, infinite
from ocp.compiled.function_address import function_behind

PRELUDE = """\
#include <math.h>
#include <stdint.h>

typedef struct { double *at; long long size[4]; } doubles;
typedef struct { float *at; long long size[4]; } floats;
typedef struct { long long *at; long long size[4]; } integers;

static inline double least(double a, double b) { return b < a ? b : a; }
static inline double most(double a, double b) { return b > a ? b : a; }
static inline long long least_i(long long a, long long b) { return b < a ? b : a; }
static inline long long most_i(long long a, long long b) { return b > a ? b : a; }
static inline long long floored(long long a, long long b)
{ return a / b - ((a % b != 0) && ((a < 0) != (b < 0))); }
"""


@dataclass
class Module:
    """The parts of the file.

    Attributes:
        translate: (module, kernel, its C name): adds the kernel to the module.
    """

    translate: Callable[["Module", Any, str], None]
    functions: dict[Any, str] = field(default_factory=dict)
    constants: dict[str, Any] = field(default_factory=dict)
    tables: int = 0
    tuples: dict[str, str] = field(default_factory=dict)
    prototypes: list[str] = field(default_factory=list)
    data: list[str] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)

    def name_of(self, dispatcher: Any) -> str:
        """The C name of a compiled function, translated on first sight."""
        if dispatcher not in self.functions:
            python = dispatcher.py_func
            name = f"{python.__module__.rsplit('.', 1)[-1]}_{python.__name__}"
            self.functions[dispatcher] = name
            self.translate(self, dispatcher, name)
        return self.functions[dispatcher]

    def constant(self, array: Any, name: str) -> str:
        """A C expression for an array of numbers that never changes."""
        array = np.asarray(array)
        kind = {"float64": "f8", "float32": "f4", "int64": "i8"}[array.dtype.name]
        key = f"{name}_{len(self.constants)}"
        digits = {"f8": 17, "f4": 9}
        flat = array.ravel()  # row by row
        if kind == "i8":
            numbers = [str(x) for x in flat]
        else:
            suffix = "f" if kind == "f4" else ""
            numbers = [
                f"{x:.{digits[kind]}g}" if np.isfinite(x) else ("NAN" if x != x else infinite(x))
                for x in flat
            ]
            numbers = [
                f"{x}{'' if set(x) & set('.eEIN') else '.0'}{suffix if 'I' not in x else ''}"
                for x in numbers
            ]
        text = textwrap.fill(", ".join(numbers) or "0", 98)
        self.data.append(f"static const {SCALARS[kind]} {key}[] = {{\n{text}\n}};")
        self.constants[key] = array
        return self.stored(key)

    def stored(self, key: str) -> str:
        """A constant as an array; nothing writes into it."""
        array = self.constants[key]
        kind = {"float64": "f8", "float32": "f4", "int64": "i8"}[array.dtype.name]
        sizes = ", ".join(map(str, array.shape))
        return f"({ARRAYS[kind]}){{({SCALARS[kind]} *){key}, {{{sizes}}}}}"

    def addressed(self, table: Any, name: str) -> tuple[str, list[str]]:
        """An array of addresses: a C expression, and the statements that fill it."""
        self.tables += 1
        key, fill = f"{name}_at_{self.tables}", []
        for row, (address, _) in enumerate(np.asarray(table)):
            target = self.name_of(function_behind(int(address)))
            fill.append(f"{key}[{2 * row}] = (long long)(intptr_t){target};")
        self.data.append(f"static long long {key}[{2 * len(table)}];")
        return f"(integers){{{key}, {{{len(table)}, 2}}}}", fill

    def tuple_type(self, kind: Type) -> str:
        if kind.c not in self.tuples:
            fields = " ".join(f"{p.c} e{i};" for i, p in enumerate(kind.parts))
            self.tuples[kind.c] = f"typedef struct {{ {fields} }} {kind.c};"
        return kind.c

    def text(self) -> str:
        """Everything so far."""
        parts = [PRELUDE, *self.tuples.values(), *self.prototypes, *self.data, *self.bodies]
        return "\n".join(parts) + "\n"
