"""numba's types of a kernel, also of one that was loaded compiled."""

from functools import cache
from typing import Any

from numba.core import compiler
from numba.core.registry import cpu_target
from numba.core.typed_passes import type_inference_stage


@cache
def inferred(dispatcher: Any) -> tuple[dict[str, Any], Any, Any]:
    """Types of a kernel's variables by name, of its arguments, and of what it returns."""
    (signature,) = dispatcher.nopython_signatures
    context = cpu_target.typing_context
    context.refresh()  # pyright: ignore[reportAttributeAccessIssue]
    ir = compiler.run_frontend(dispatcher.py_func)
    found = type_inference_stage(
        context, cpu_target.target_context, ir, signature.args, signature.return_type
    )
    by_name: dict[str, Any] = {}
    for name, kind in found.typemap.items():
        plain = name.split(".")[0]
        if name.startswith(("$", "arg.")) or not plain.isidentifier():
            continue
        by_name.setdefault(plain, []).append(kind)
    return by_name, signature.args, signature.return_type
