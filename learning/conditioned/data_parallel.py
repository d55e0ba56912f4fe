"""Training on several processes, started by torch's own launcher, gradients summed over gloo.

    torchrun --nproc-per-node 2 --no-python zermelo train CONFIG --out DIR

Every process draws the same batch and differentiates its own part of it; the sum is the gradient
of the whole batch, so the run follows that of one process up to rounding.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

PATIENCE = timedelta(days=1)
"""How long a process waits for the others: the first of them may be sampling the family."""


@dataclass(frozen=True)
class Crew:
    """The processes of one training run.

    Attributes:
        rank: of this process; 0 leads: it alone samples and writes.
        size: how many they are.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        return self.rank == 0

    def part(self) -> slice:
        """The samples of a batch that are this process's."""
        return slice(self.rank, None, self.size)

    def wait(self) -> None:
        """Until all have come this far."""
        if self.size > 1:
            dist.barrier()

    def sum_gradients(self, network: torch.nn.Module) -> None:
        """Replace each gradient by its sum over all processes, in one message."""
        if self.size > 1:
            gradients = [p.grad for p in network.parameters() if p.grad is not None]
            together = torch.cat([g.flatten() for g in gradients])
            dist.all_reduce(together)
            parts = together.split([g.numel() for g in gradients])
            for gradient, part in zip(gradients, parts, strict=True):
                gradient.copy_(part.view_as(gradient))

    def summed(self, values: Tensor) -> Tensor:
        """The sum of `values` over all processes."""
        if self.size > 1:
            values = values.clone()
            dist.all_reduce(values)
        return values


ALONE = Crew()


@contextmanager
def launched() -> Iterator[Crew]:
    """The crew that torch's launcher started, or this process alone if none did."""
    if not dist.is_torchelastic_launched():
        yield ALONE
        return
    if os.environ.get("MASTER_ADDR") in ("localhost", "127.0.0.1"):
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # one machine: nothing goes outside
    dist.init_process_group("gloo", timeout=PATIENCE)
    try:
        yield Crew(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
