"""Expressions of a kernel in C."""

import ast
import inspect
import math
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import types

from ocp.c_code.inference import inferred
from ocp.c_code.module import Module
from ocp.c_code.types import (
    SCALARS,
    Type,
    UntranslatableError,
    c_name,
    declared,
    joined,
    number,
    type_of,
)

UNARY_MATH = {
    "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "asin", "acos", "atan", "sinh",
    "cosh", "tanh", "floor", "ceil", "fabs",
}  # fmt: skip
BINARY_MATH = {"atan2", "hypot", "copysign"}
OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}
BITS = {ast.LShift: "<<", ast.RShift: ">>", ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
COMPARISONS = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="
}  # fmt: skip


class Expressions(ABC):
    """What is known while one kernel is translated, and its expressions."""

    def __init__(self, module: Module, dispatcher: Any, name: str) -> None:
        self.module, self.dispatcher, self.name = module, dispatcher, name
        python = dispatcher.py_func
        tree = ast.parse(textwrap.dedent(inspect.getsource(python)))
        definition = tree.body[0]
        assert isinstance(definition, ast.FunctionDef)
        self.definition, self.globals = definition, python.__globals__
        names, arguments, returned = inferred(dispatcher)
        self.names = {n: self._merged(n, kinds) for n, kinds in names.items()}
        self.arguments = [a.arg for a in definition.args.args]
        for argument, kind in zip(self.arguments, arguments, strict=True):
            self.names[argument] = type_of(kind)
        self.returned = type_of(returned)
        self.lines: list[str] = []
        self.depth, self.fresh = 1, 0
        self.blocks: list[Sequence[ast.stmt]] = []

    def _merged(self, name: str, kinds: Sequence[Any]) -> Type:
        """The one C type of a Python variable that may have several in turn."""
        found = {type_of(k) for k in kinds if not isinstance(k, types.Dispatcher)}
        if len(found) > 1 and all(t.base in SCALARS and not t.axes for t in found):
            order = ["b1", "i8", "f4", "f8"]
            return Type(max((t.base for t in found), key=order.index))
        if len(found) != 1:
            raise UntranslatableError(f"{self.name}: variable {name} changes its type")
        return found.pop()

    def emit(self, line: str) -> None:
        self.lines.append("    " * self.depth + line)

    def new(self) -> str:
        self.fresh += 1
        return f"t{self.fresh}_"

    def fail(self, node: ast.AST, what: str) -> UntranslatableError:
        return UntranslatableError(f"{self.name}: {what}: {ast.unparse(node)}")

    def held(self, code: str, kind: Type) -> str:
        if code.isidentifier():
            return code
        name = self.new()
        self.emit(f"{kind.c} {name} = {code};")
        return name

    def sizes(self, code: str, kind: Type) -> list[str]:
        return [f"{code}.size[{i}]" for i in range(kind.axes)]

    @abstractmethod
    def is_fresh(self, node: ast.expr) -> bool:
        """Whether an expression makes a new array."""
        ...

    @abstractmethod
    def allocated(self, node: ast.expr) -> tuple[str, Type]:
        """A new array, as an expression."""
        ...

    @abstractmethod
    def reshaped(self, code: str, kind: Type, node: ast.Call) -> tuple[str, Type]:
        """An array seen in another shape."""
        ...

    def array(self, node: ast.expr) -> tuple[str, Type]:
        """An array, or other value, by a name that may be repeated."""
        code, kind = self.allocated(node) if self.is_fresh(node) else self.value(node)
        return (self.held(code, kind) if kind.axes or kind.base == "tuple" else code), kind

    def value(self, node: ast.expr) -> tuple[str, Type]:
        """C code of an expression, and its type."""
        method = getattr(self, "of_" + type(node).__name__, None)
        if method is None:
            raise self.fail(node, "no translation")
        return method(node)

    def of_Constant(self, node: ast.Constant) -> tuple[str, Type]:
        return number(node.value)

    def of_Name(self, node: ast.Name) -> tuple[str, Type]:
        if node.id in self.names:
            return c_name(node.id), self.names[node.id]
        found = self.globals.get(node.id)
        if isinstance(found, np.ndarray):
            kind = Type({"float64": "f8", "int64": "i8"}[found.dtype.name], found.ndim)
            for key, array in self.module.constants.items():
                if array is found:
                    return self.module.stored(key), kind
            return self.module.constant(found, node.id), kind
        if isinstance(found, int | float):
            return number(found)
        if type(found) is np.float32:
            return f"{float(found)!r}f", Type("f4")
        raise self.fail(node, "unknown name")

    def of_Attribute(self, node: ast.Attribute) -> tuple[str, Type]:
        text = ast.unparse(node)
        if text in ("np.inf", "math.inf"):
            return "INFINITY", Type("f8")
        if text in ("np.nan", "math.nan"):
            return "NAN", Type("f8")
        if text in ("math.pi", "np.pi"):
            return number(math.pi)
        code, kind = self.value(node.value)
        if node.attr == "shape":
            return f"{code}.size", Type("tuple", parts=(Type("i8"),) * kind.axes)
        if node.attr == "size":
            return f"({' * '.join(self.sizes(code, kind))})", Type("i8")
        raise self.fail(node, "no translation")

    def of_Subscript(self, node: ast.Subscript) -> tuple[str, Type]:
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            return f"{self.value(node.value)[0]}[{self.value(node.slice)[0]}]", Type("i8")
        if isinstance(node.value, ast.Name) and isinstance(self.globals.get(node.value.id), tuple):
            return number(self.globals[node.value.id][ast.literal_eval(node.slice)])
        code, kind = self.value(node.value)
        if kind.base == "tuple":
            index = node.slice
            if isinstance(index, ast.Constant) and isinstance(index.value, int):
                return f"{code}.e{index.value}", kind.parts[index.value]
            base, parts = kind.parts[0], ", ".join(f"{code}.e{i}" for i in range(len(kind.parts)))
            return f"(({base.c}[]){{{parts}}})[{self.value(index)[0]}]", base
        if not code.isidentifier():
            code = self.held(code, kind)
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        offset, sizes = "0", []
        for axis in range(kind.axes):
            part = parts[axis] if axis < len(parts) else ast.Slice()
            size = f"{code}.size[{axis}]"
            offset = f"({offset}) * {size}" if axis else offset
            if isinstance(part, ast.Slice):
                if part.step is not None or (sizes and (part.lower or part.upper)):
                    raise self.fail(node, "not a contiguous part")
                low = "0" if part.lower is None else self.end(part.lower, size)
                high = size if part.upper is None else self.end(part.upper, size)
                offset = f"{offset} + ({low})"
                sizes.append(f"({high}) - ({low})" if low != "0" else high)
            elif sizes:
                raise self.fail(node, "not a contiguous part")
            else:
                offset = f"{offset} + {self.end(part, size)}"
        offset = offset.removeprefix("0 + ")
        if not sizes:
            return f"{code}.at[{offset}]", Type(kind.base)
        made = Type(kind.base, len(sizes))
        return f"({made.c}){{{code}.at + ({offset}), {{{', '.join(sizes)}}}}}", made

    def end(self, node: ast.expr, size: str) -> str:
        """An index; negative constants count from the end."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            return f"{size} - {self.value(node.operand)[0]}"
        return f"({self.value(node)[0]})" if isinstance(node, ast.BinOp) else self.value(node)[0]

    def of_UnaryOp(self, node: ast.UnaryOp) -> tuple[str, Type]:
        code, kind = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            return f"(!({code}))", Type("b1")
        return f"({'-' if isinstance(node.op, ast.USub) else '+'}{code})", kind

    def of_BinOp(self, node: ast.BinOp) -> tuple[str, Type]:
        (left, a), (right, b) = self.value(node.left), self.value(node.right)
        kind = joined(a, b)
        if type(node.op) in OPERATORS:
            return f"({left} {OPERATORS[type(node.op)]} {right})", kind
        if isinstance(node.op, ast.Div):
            if kind.base == "i8":
                return f"((double){left} / (double){right})", Type("f8")
            return f"({left} / {right})", kind
        if isinstance(node.op, ast.FloorDiv) and kind.base == "i8":
            return f"floored({left}, {right})", kind
        if isinstance(node.op, ast.Mod) and kind.base == "i8":
            return f"({left} - {right} * floored({left}, {right}))", kind
        if isinstance(node.op, ast.Pow):
            power = node.right.value if isinstance(node.right, ast.Constant) else None
            if isinstance(power, int) and 1 <= power <= 4 and left.isidentifier():
                return "(" + " * ".join([left] * power) + ")", kind
            return f"pow({left}, {right})", Type("f8")
        if type(node.op) in BITS and kind.base == "i8":
            return f"((long long){left} {BITS[type(node.op)]} {right})", kind
        raise self.fail(node, "no translation")

    def of_BoolOp(self, node: ast.BoolOp) -> tuple[str, Type]:
        sign = " && " if isinstance(node.op, ast.And) else " || "
        return "(" + sign.join(self.value(v)[0] for v in node.values) + ")", Type("b1")

    def of_Compare(self, node: ast.Compare) -> tuple[str, Type]:
        terms = [self.value(e)[0] for e in (node.left, *node.comparators)]
        pairs = zip(terms[:-1], node.ops, terms[1:], strict=True)
        tests = [f"({a} {COMPARISONS[type(o)]} {b})" for a, o, b in pairs]
        return (tests[0] if len(tests) == 1 else f"({' && '.join(tests)})"), Type("b1")

    def of_IfExp(self, node: ast.IfExp) -> tuple[str, Type]:
        (yes, a), (no, b) = self.value(node.body), self.value(node.orelse)
        kind = a if a.axes or a.base == "function" else joined(a, b)
        return f"({self.value(node.test)[0]} ? {yes} : {no})", kind

    def of_Call(self, node: ast.Call) -> tuple[str, Type]:
        name = ast.unparse(node.func)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "reshape":
            code, kind = self.array(node.func.value)
            return self.reshaped(code, kind, node)
        if self.is_fresh(node):
            return self.allocated(node)
        target = self.globals.get(name)
        if hasattr(target, "py_func"):
            (signature,) = target.nopython_signatures
            return self.called(self.module.name_of(target), signature, node.args)
        if type(target).__name__ == "_Intrinsic":
            kind = inspect.getclosurevars(target._defn).nonlocals["function_type"]
            address = self.value(node.args[0])[0]
            made = type_of(kind)
            return f"({declared(made, '')})(intptr_t){address}", made
        if isinstance(node.func, ast.Name) and name in self.names:
            return self.called(c_name(name), self.names[name].signature, node.args)
        if isinstance(node.func, ast.Call):
            code, kind = self.value(node.func)
            return self.called(f"({code})", kind.signature, node.args)
        return self.of_library(node, name)

    def called(self, code: str, signature: Any, nodes: Sequence[ast.expr]) -> tuple[str, Type]:
        arguments = []
        for node in nodes:
            if isinstance(node, ast.Starred):
                held, made = self.array(node.value)
                arguments += [f"{held}.e{i}" for i in range(len(made.parts))]
            else:
                arguments.append(self.array(node)[0])
        kind = type_of(signature.return_type)
        if kind.base == "tuple":
            self.module.tuple_type(kind)
        return f"{code}({', '.join(arguments)})", kind

    def of_library(self, node: ast.Call, name: str) -> tuple[str, Type]:
        values = [self.value(a) for a in node.args]
        codes, kinds = [c for c, _ in values], [k for _, k in values]
        short = name.split(".")[-1]
        if name in ("min", "max", "np.minimum", "np.maximum"):
            word = {"min": "least", "max": "most"}[short[:3]]
            kind = kinds[0]
            for other in kinds[1:]:
                kind = joined(kind, other)
            code = codes[0]
            for other in codes[1:]:
                code = f"{word}{'_i' if kind.base == 'i8' else ''}({code}, {other})"
            return code, kind
        if name in ("int", "np.int64"):
            return f"((long long)({codes[0]}))", Type("i8")
        if name in ("float", "np.float64"):
            return f"((double)({codes[0]}))", Type("f8")
        if name == "np.float32":
            return f"((float)({codes[0]}))", Type("f4")
        if name == "len":
            return f"{codes[0]}.size[0]", Type("i8")
        if short == "abs":
            return f"{'llabs' if kinds[0].base == 'i8' else 'fabs'}({codes[0]})", kinds[0]
        if short in ("isnan", "isfinite", "isinf"):
            return f"({short}({codes[0]}) != 0)", Type("b1")
        if short in ("round", "rint"):
            return f"rint({codes[0]})", Type("f8")
        if short in UNARY_MATH and kinds[0].axes == 0:
            single = kinds[0].base == "f4"
            kind = Type("f4" if single else "f8")
            integral = name.startswith("math.") and short in ("floor", "ceil")
            code = f"{short}{'f' if single else ''}({codes[0]})"
            return (f"((long long){code})", Type("i8")) if integral else (code, kind)
        if short in BINARY_MATH:
            return f"{short}({', '.join(codes)})", Type("f8")
        raise self.fail(node, "no translation")
