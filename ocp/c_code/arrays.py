"""Arrays of a kernel in C: new ones on the stack, products, and loops over entries."""

import ast
from collections.abc import Callable, Sequence

from ocp.c_code.expressions import OPERATORS, Expressions
from ocp.c_code.types import ARRAYS, SCALARS, Type


class Arrays(Expressions):
    """Expressions, with those that make arrays or run over their entries."""

    def check_reach(self, name: ast.Name) -> None:
        """A new array lives in its block only: whatever reads it must stand there."""

        def count(nodes: Sequence[ast.AST]) -> int:
            found = [m for n in nodes for m in ast.walk(n) if isinstance(m, ast.Name)]
            return sum(m.id == name.id for m in found)

        if count(self.blocks[-1]) != count([self.definition]):
            raise self.fail(name, "an array that is read outside the block that makes it")

    def is_fresh(self, node: ast.expr) -> bool:
        """Whether an expression makes a new array."""
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            if name in ("np.empty", "np.zeros", "np.ones", "np.full", "np.dot") or name in (
                "np.empty_like", "np.zeros_like",
            ):  # fmt: skip
                return True
            if isinstance(node.func, ast.Attribute) and node.func.attr in ("copy", "astype"):
                return True
            if isinstance(node.func, ast.Attribute) and node.func.attr == "reshape":
                return self.is_fresh(node.func.value)
        return False

    def room(self, base: str, sizes: Sequence[str]) -> str:
        """A new array on the stack, as long as the block lasts."""
        name = self.new()
        count = " * ".join(f"({s})" for s in sizes)
        self.emit(f"{SCALARS[base]} {name}[most_i(1, {count})];")
        return f"({ARRAYS[base]}){{{name}, {{{', '.join(sizes)}}}}}"

    def allocated(self, node: ast.expr) -> tuple[str, Type]:
        """A new array, as an expression."""
        assert isinstance(node, ast.Call)
        name = ast.unparse(node.func)
        if name in ("np.empty", "np.zeros", "np.ones", "np.full"):
            shape = node.args[0]
            if isinstance(shape, ast.Attribute) and shape.attr == "shape":
                sizes = self.sizes(*self.array(shape.value))
            else:
                elements = shape.elts if isinstance(shape, ast.Tuple) else [shape]
                sizes = [self.value(e)[0] for e in elements]
            base = "f8"
            for keyword in node.keywords:
                if keyword.arg == "dtype":
                    base = {"np.float32": "f4", "np.int64": "i8"}[ast.unparse(keyword.value)]
            kind = Type(base, len(sizes))
            held = self.held(self.room(base, sizes), kind)
            if name != "np.empty":
                fill = {"np.zeros": ast.Constant(0.0), "np.ones": ast.Constant(1.0)}
                self.each(held, kind, "=", fill[name] if name in fill else node.args[1])
            return held, kind
        if name in ("np.empty_like", "np.zeros_like"):
            code, kind = self.value(node.args[0])
            held = self.held(self.room(kind.base, self.sizes(code, kind)), kind)
            if name == "np.zeros_like":
                self.each(held, kind, "=", ast.Constant(0.0))
            return held, kind
        if name == "np.dot":
            return self.product(node)
        assert isinstance(node.func, ast.Attribute)
        inner = node.func.value
        if node.func.attr == "reshape":
            code, kind = self.allocated(inner)
            return self.reshaped(self.held(code, kind), kind, node)
        code, kind = self.array(inner)
        base = kind.base
        if node.func.attr == "astype":
            base = {"np.float32": "f4", "np.float64": "f8"}[ast.unparse(node.args[0])]
        made = Type(base, kind.axes)
        held = self.held(self.room(base, self.sizes(code, kind)), made)
        i = self.new()
        count = " * ".join(self.sizes(held, made))
        self.emit(f"for (long long {i} = 0; {i} < {count}; {i}++) {held}.at[{i}] = {code}.at[{i}];")
        return held, made

    def product(self, node: ast.Call) -> tuple[str, Type]:
        (a, ka), (b, kb) = self.array(node.args[0]), self.array(node.args[1])
        if ka.axes != 2 or kb.axes != 2 or ka.base != kb.base:
            raise self.fail(node, "only products of two matrices")
        held = self.held(self.room(ka.base, [f"{a}.size[0]", f"{b}.size[1]"]), ka)
        i, j, k, total = self.new(), self.new(), self.new(), self.new()
        for line in (
            f"for (long long {i} = 0; {i} < {a}.size[0]; {i}++)",
            f"    for (long long {j} = 0; {j} < {b}.size[1]; {j}++) {{",
            f"        {SCALARS[ka.base]} {total} = 0;",
            f"        for (long long {k} = 0; {k} < {b}.size[0]; {k}++)",
            f"            {total} += {a}.at[{i} * {a}.size[1] + {k}]"
            f" * {b}.at[{k} * {b}.size[1] + {j}];",
            f"        {held}.at[{i} * {b}.size[1] + {j}] = {total};",
            "    }",
        ):
            self.emit(line)
        return held, ka

    def each(self, place: str, kind: Type, operator: str, value: ast.expr) -> None:
        """`place op value` for every entry; a value of fewer axes is repeated along the first."""
        self.emit("{")
        self.depth += 1
        held = self.held(place, kind)
        if isinstance(value, ast.Call) and self.is_fresh(value):
            code, inner = self.array(value)
            entry = lambda indices: self.entry(code, inner, indices)  # noqa: E731
        else:
            entry = self.entrywise(value)
        indices = [self.new() for _ in range(kind.axes)]
        for axis, i in enumerate(indices):
            self.emit(f"for (long long {i} = 0; {i} < {held}.size[{axis}]; {i}++) {{")
            self.depth += 1
        self.emit(f"{self.entry(held, kind, indices)} {operator} {entry(indices)};")
        for _ in indices:
            self.depth -= 1
            self.emit("}")
        self.depth -= 1
        self.emit("}")

    def entrywise(self, node: ast.expr) -> Callable[[Sequence[str]], str]:
        """From loop indices to the entry of an expression of arrays and scalars."""
        if isinstance(node, ast.BinOp) and isinstance(node.op, (*OPERATORS, ast.Div)):
            left, right = self.entrywise(node.left), self.entrywise(node.right)
            operator = "/" if isinstance(node.op, ast.Div) else OPERATORS[type(node.op)]
            return lambda indices: f"({left(indices)} {operator} {right(indices)})"
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            inner = self.entrywise(node.operand)
            return lambda indices: f"(-{inner(indices)})"
        code, kind = self.value(node)
        name = self.new()
        self.emit(f"{kind.c} {name} = {code};")
        return lambda indices: self.entry(name, kind, indices) if kind.axes else name

    def entry(self, name: str, kind: Type, indices: Sequence[str]) -> str:
        last = list(indices)[len(indices) - kind.axes :]
        flat = last[0]
        for axis, i in enumerate(last[1:], start=1):
            flat = f"({flat}) * {name}.size[{axis}] + {i}"
        return f"{name}.at[{flat}]"

    def reshaped(self, code: str, kind: Type, node: ast.Call) -> tuple[str, Type]:
        shape = node.args[0] if len(node.args) == 1 else ast.Tuple(node.args)
        elements = shape.elts if isinstance(shape, ast.Tuple) else [shape]
        if len(elements) == 1 and ast.unparse(elements[0]) == "-1":
            sizes = [" * ".join(self.sizes(code, kind))]
        else:
            sizes = [self.value(e)[0] for e in elements]
        made = Type(kind.base, len(sizes))
        return f"({made.c}){{{code}.at, {{{', '.join(sizes)}}}}}", made
