"""The value conditioned on its query: a network that knows obstacles as a set.

    V(x) = V_free(x) (1 + softplus(min_k N_k(x))),
    N(x) = trunk(state, sum over obstacles o of member(state, o))

V_free is the exact value without obstacles, which V never falls below. It carries the goal: V is
exact where no obstacle is felt, has the right kink at tangential headings, and what N has to learn
stays bounded down to the goal. The sum makes the order of obstacles irrelevant and their number
free. Each head N_k may describe one class of motions: their least has V's kinks.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from learning.conditioned.query_encoder import (
    OBSTACLE_FEATURES,
    ODD_OBSTACLE,
    ODD_STATE,
    STATE_FEATURES,
)


@dataclass(frozen=True)
class Widths:
    """Sizes of the network.

    Attributes:
        member: units of each of the two layers that see one obstacle.
        trunk: units of each of the two layers behind the sum.
        heads: number of N_k.
    """

    member: int = 48
    trunk: int = 96
    heads: int = 4


class ConditionedNetwork(nn.Module):
    """min_k N_k from features; inputs are standardised by fixed numbers (`standardise`)."""

    state_mean: Tensor
    state_scale: Tensor
    obstacle_mean: Tensor
    obstacle_scale: Tensor

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        self.widths = widths
        member, trunk = widths.member, widths.trunk
        self.member_state = nn.Linear(STATE_FEATURES, member)
        self.member_obstacle = nn.Linear(OBSTACLE_FEATURES, member, bias=False)
        self.member_hidden = nn.Linear(member, member)
        self.trunk_state = nn.Linear(STATE_FEATURES, trunk)
        self.trunk_sum = nn.Linear(member, trunk, bias=False)
        self.trunk_hidden = nn.Linear(trunk, trunk)
        self.heads = nn.Linear(trunk, widths.heads)
        for name, size in (("state", STATE_FEATURES), ("obstacle", OBSTACLE_FEATURES)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))

    def standardise(self, state: Tensor, obstacle: Tensor) -> None:
        """Set mean and scale from features `[k, s]` and `[j, f]`; odd ones keep mean 0."""
        for name, features, odd in (
            ("state", state, ODD_STATE),
            ("obstacle", obstacle, ODD_OBSTACLE),
        ):
            mean, scale = features.mean(0), features.std(0).clamp(min=1e-3)
            mean[list(odd)] = 0.0
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_scale").copy_(scale)

    def forward(self, state: Tensor, obstacle: Tensor, owner: Tensor) -> Tensor:
        """All N_k `[k, heads]`.

        Args:
            state: features `[k, s]`.
            obstacle: features `[j, f]` of all obstacles of all rows of `state`.
            owner: `[j]`, the row each belongs to.
        """
        silu = nn.functional.silu
        s = (state - self.state_mean) / self.state_scale
        f = (obstacle - self.obstacle_mean) / self.obstacle_scale
        first = silu(self.member_obstacle(f) + self.member_state(s)[owner])
        second = silu(self.member_hidden(first))
        # Not `len(s)`, which ties an exported network to one number of states.
        zero = torch.zeros(s.shape[0], second.shape[1], dtype=second.dtype)
        total = zero.index_add(0, owner, second)
        hidden = silu(self.trunk_sum(total) + self.trunk_state(s))
        return self.heads(silu(self.trunk_hidden(hidden)))


@dataclass(frozen=True)
class Batch:
    """States of many queries, in features; `t` directions in which derivatives are wanted.

    Attributes:
        free: `[k, 1 + t]`, V_free and its derivatives.
        state, state_slopes: `[k, s]` and `[k, s, t]`.
        obstacle, obstacle_slopes: `[j, f]` and `[j, f, t]`.
        owner: `[j]`, the row of each obstacle.
    """

    free: Tensor
    state: Tensor
    state_slopes: Tensor
    obstacle: Tensor
    obstacle_slopes: Tensor
    owner: Tensor


def value_and_slopes(
    network: ConditionedNetwork, batch: Batch, create_graph: bool = True
) -> tuple[Tensor, Tensor]:
    """V `[k]` and its derivatives `[k, t]` in the batch's directions."""
    state = batch.state.requires_grad_()
    obstacle = batch.obstacle.requires_grad_()
    n = network(state, obstacle, batch.owner).amin(dim=1)
    by_state, by_obstacle = torch.autograd.grad(
        n.sum(), [state, obstacle], create_graph=create_graph
    )
    slopes = torch.einsum("ks,kst->kt", by_state, batch.state_slopes)
    slopes = slopes.index_add(
        0, batch.owner, torch.einsum("jf,jft->jt", by_obstacle, batch.obstacle_slopes)
    )
    extra = nn.functional.softplus(n)
    V_free = batch.free[:, 0]
    V = V_free * (1 + extra)
    return V, batch.free[:, 1:] * (1 + extra)[:, None] + (V_free * torch.sigmoid(n))[
        :, None
    ] * slopes
