"""Compiled kernels in dependency-free C99: the very functions that numba compiles, statement by
statement.

What is exported is thereby what is run: there is no second definition of a robot, a cost or a
network. Types are numba's own inference. The subset is that of the kernels: scalars, contiguous
arrays, loops, calls of one another (directly or by address); anything else is refused.
"""

import ast
from collections.abc import Sequence

from ocp.c_code.arrays import Arrays
from ocp.c_code.expressions import OPERATORS
from ocp.c_code.module import Module
from ocp.c_code.types import c_name, declared


def new_module() -> Module:
    """An empty C file, to which kernels are added by `name_of`."""
    return Module(lambda module, dispatcher, name: Statements(module, dispatcher, name).translate())


class Statements(Arrays):
    """One kernel, being translated."""

    def translate(self) -> None:
        arguments = ", ".join(declared(self.names[a], c_name(a)) for a in self.arguments)
        if self.returned.base == "tuple":
            self.module.tuple_type(self.returned)
        head = f"static {self.returned.c} {self.name}({arguments})"
        self.module.prototypes.append(head + ";")
        for name, kind in self.names.items():
            if name in self.arguments or kind.base == "void":
                continue
            if kind.base == "tuple":
                self.module.tuple_type(kind)
            self.emit(f"{declared(kind, c_name(name))};")
        self.block(self.definition.body)
        body = "\n".join(self.lines)
        self.module.bodies.append(f"{head}\n{{\n{body}\n}}\n")

    def block(self, body: Sequence[ast.stmt]) -> None:
        self.blocks.append(body)
        for statement in body:
            method = getattr(self, "on_" + type(statement).__name__, None)
            if method is None:
                raise self.fail(statement, "no translation")
            method(statement)
        self.blocks.pop()

    def indented(self, head: str, body: Sequence[ast.stmt], before: Sequence[str] = ()) -> None:
        self.emit(head + " {")
        self.depth += 1
        for line in before:
            self.emit(line)
        self.block(body)
        self.depth -= 1
        self.emit("}")

    def on_Expr(self, s: ast.Expr) -> None:
        if isinstance(s.value, ast.Constant):  # a docstring
            return
        self.emit(self.value(s.value)[0] + ";")

    def on_Pass(self, _: ast.Pass) -> None:
        pass

    def on_Break(self, _: ast.Break) -> None:
        self.emit("break;")

    def on_Continue(self, _: ast.Continue) -> None:
        self.emit("continue;")

    def on_Return(self, s: ast.Return) -> None:
        if s.value is None:
            self.emit("return;")
        elif isinstance(s.value, ast.Tuple):
            parts = ", ".join(self.value(e)[0] for e in s.value.elts)
            self.emit(f"return ({self.returned.c}){{{parts}}};")
        elif isinstance(s.value, ast.IfExp) and isinstance(s.value.body, ast.Tuple):
            here = s.value
            branch = ast.If(here.test, [ast.Return(here.body)], [ast.Return(here.orelse)])
            self.on_If(branch)
        else:
            self.emit(f"return {self.value(s.value)[0]};")

    def on_If(self, s: ast.If) -> None:
        self.indented(f"if ({self.value(s.test)[0]})", s.body)
        if s.orelse:
            self.indented("else", s.orelse)

    def on_While(self, s: ast.While) -> None:
        if s.orelse:
            raise self.fail(s, "while-else")
        self.indented(f"while ({self.value(s.test)[0]})", s.body)

    def on_For(self, s: ast.For) -> None:
        if s.orelse:
            raise self.fail(s, "for-else")
        called = s.iter
        if isinstance(called, ast.Call) and ast.unparse(called.func) == "range":
            bounds = [self.value(a)[0] for a in called.args]
            low, high = ("0", bounds[0]) if len(bounds) == 1 else bounds[:2]
            step = bounds[2] if len(bounds) == 3 else "1"
            assert isinstance(s.target, ast.Name)
            i, end = self.new(), self.new()
            back = step.startswith("(-")
            if not back and not step.isdigit() and not step.isidentifier():
                raise self.fail(s.iter, "no translation of this step")
            test = f"{i} {'>' if back else '<'} {end}"
            head = f"for (long long {i} = {low}, {end} = {high}; {test}; {i} += {step})"
            # A name that is never read has no type, and no variable.
            known = s.target.id in self.names
            self.indented(head, s.body, [f"{c_name(s.target.id)} = {i};"] if known else [])
            return
        if isinstance(called, ast.Name) and isinstance(self.globals.get(called.id), tuple):
            rows: list[ast.expr] = [ast.Constant(x) for x in self.globals[called.id]]
        elif isinstance(called, ast.Tuple):
            rows = called.elts
        else:
            raise self.fail(s.iter, "no translation of this loop")
        for row in rows:  # written out
            self.emit("{")
            self.depth += 1
            self.assign(s.target, row)
            self.block(s.body)
            self.depth -= 1
            self.emit("}")

    def on_Assign(self, s: ast.Assign) -> None:
        for target in s.targets:
            self.assign(target, s.value)

    def assign(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Tuple):
            self.unpack(target.elts, value)
            return
        if isinstance(target, ast.Name):
            if self.names[target.id].axes and self.is_fresh(value):
                self.check_reach(target)
                self.emit(f"{c_name(target.id)} = {self.allocated(value)[0]};")
                return
            self.emit(f"{c_name(target.id)} = {self.value(value)[0]};")
            return
        place, kind = self.value(target)
        if kind.axes == 0:
            self.emit(f"{place} = {self.value(value)[0]};")
        else:
            self.each(place, kind, "=", value)

    def unpack(self, targets: Sequence[ast.expr], value: ast.expr) -> None:
        if isinstance(value, ast.IfExp):
            target = ast.Tuple(list(targets))
            yes, no = ast.Assign([target], value.body), ast.Assign([target], value.orelse)
            self.on_If(ast.If(value.test, [yes], [no]))
            return
        if isinstance(value, ast.Tuple):
            if any(self.is_fresh(v) for v in value.elts):
                for target, v in zip(targets, value.elts, strict=True):
                    self.assign(target, v)
                return
            held = []
            for v in value.elts:  # all are evaluated before any is assigned
                code, kind = self.value(v)
                name = self.new()
                self.emit(f"{declared(kind, name)} = {code};")
                held.append(name)
        else:
            code, kind = self.value(value)
            name = self.new()
            if isinstance(value, ast.Attribute):  # a shape
                held = [f"{code}[{i}]" for i in range(len(targets))]
            else:
                self.emit(f"{self.module.tuple_type(kind)} {name} = {code};")
                held = [f"{name}.e{i}" for i in range(len(targets))]
        for target, code in zip(targets, held, strict=True):
            if isinstance(target, ast.Name):
                if target.id in self.names and target.id != "_":
                    self.emit(f"{c_name(target.id)} = {code};")
                continue
            place, kind = self.value(target)
            if kind.axes:
                raise self.fail(target, "an array among several targets")
            self.emit(f"{place} = {code};")

    def on_AugAssign(self, s: ast.AugAssign) -> None:
        place, kind = self.value(s.target)
        if kind.axes:
            if isinstance(s.op, ast.Div):
                self.each(place, kind, "/=", s.value)
            else:
                self.each(place, kind, OPERATORS[type(s.op)] + "=", s.value)
            return
        code, right = self.value(s.value)
        if isinstance(s.op, ast.Div):
            self.emit(f"{place} /= {code};")
        elif type(s.op) in OPERATORS:
            self.emit(f"{place} {OPERATORS[type(s.op)]}= {code};")
        else:
            raise self.fail(s, "no translation")
        del right
