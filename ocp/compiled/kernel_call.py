"""How a policy calls the one compiled function behind it: what else runs it needs to know."""

from dataclasses import dataclass
from typing import Any, Protocol

from ocp.query import Query


@dataclass(frozen=True)
class KernelCall:
    """`function(*before, states, *after, inputs)` fills inputs `[k, m]` at states `[k, n]`.

    Attributes:
        function: compiled, of one signature.
        before, after: arrays (of numbers, or of `addresses`) and numbers that never change.
    """

    function: Any
    before: tuple[Any, ...] = ()
    after: tuple[Any, ...] = ()


class KernelPolicy(Protocol):
    """A policy that is one compiled call."""

    @property
    def query(self) -> Query: ...

    @property
    def kernel_call(self) -> KernelCall: ...
