"""Independent truths for the planners' tests."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ocp.obstacle import Obstacle
from planners.rrtx import RRTX
from planners.update import TreeView


def costs_by_dijkstra(view: TreeView, one_way: NDArray[np.bool_] | None = None) -> NDArray:
    """Cost-to-go `[n]` over the unblocked edges.

    Args:
        one_way: `[m]`, edges that serve only their newer end.
    """
    free = ~view.blocked
    older, newer = view.edges[free].T
    both = np.ones(free.sum(), dtype=bool) if one_way is None else ~one_way[free]
    # Away from the goal: an edge of the tree runs from the node that is used to the one that uses.
    rows = np.concatenate([older, newer[both]])
    columns = np.concatenate([newer, older[both]])
    lengths = np.concatenate([view.lengths[free], view.lengths[free][both]])
    graph = csr_array((lengths, (rows, columns)), shape=(len(view.points),) * 2)
    return dijkstra(graph, indices=view.root)


def hops(view: TreeView) -> NDArray:
    """Number of edges `[n]` from each node to the root; raises if a node meets itself."""
    count = np.zeros(len(view.points), dtype=int)
    at = view.parent.copy()
    for _ in range(len(view.points) + 1):
        on = at >= 0
        if not on.any():
            return count
        count[on] += 1
        at[on] = view.parent[at[on]]
    raise AssertionError("a node is its own ancestor")


def check_tree(view: TreeView, epsilon: float = 0.0) -> None:
    """Structure: no cycles, free parent edges, look-ahead values that agree with the tree."""
    hops(view)
    free = {
        tuple(edge): length
        for edge, length in zip(view.edges[~view.blocked], view.lengths[~view.blocked], strict=True)
    }
    children = np.flatnonzero(view.parent >= 0)
    for node in children:
        pair = (int(view.parent[node]), int(node))
        edge = pair if pair in free else pair[::-1]
        assert edge in free, "a parent edge is blocked"
        slack = view.cost_to_go[node] - (free[edge] + view.cost_to_go[pair[0]])
        # A node that waits for repair has not told its children yet.
        assert slack >= 0
        if view.consistent[pair[0]]:
            assert slack <= epsilon
    rooted = np.isfinite(view.cost_to_go)
    assert np.array_equal(np.flatnonzero(rooted), np.union1d(children, [view.root]))
    assert view.cost_to_go[view.root] == 0
    told = view.consistent & rooted
    assert (view.announced[told] - view.cost_to_go[told] <= epsilon).all()
    assert (view.announced >= view.cost_to_go).all()


def check_costs(planner: RRTX, epsilon: float = 0.0) -> None:
    """Settled costs are Dijkstra's, exactly at epsilon 0, else within epsilon a hop."""
    planner.settle()
    view = planner.view()
    check_tree(view, epsilon)
    assert view.consistent.all()
    truth = costs_by_dijkstra(view)
    if epsilon == 0:
        assert np.array_equal(view.cost_to_go, truth)
        return
    finite = np.isfinite(truth)
    assert np.array_equal(finite, np.isfinite(view.cost_to_go))
    excess = view.cost_to_go[finite] - truth[finite]
    assert excess.min() >= -1e-9
    assert (excess <= epsilon * hops_of_dijkstra(view)[finite] + 1e-9).all()


def hops_of_dijkstra(view: TreeView) -> NDArray:
    """Number of edges `[n]` of the best ways."""
    free = ~view.blocked
    graph = csr_array(
        (view.lengths[free], tuple(view.edges[free].T)), shape=(len(view.points),) * 2
    )
    cost, before = dijkstra(graph, directed=False, indices=view.root, return_predecessors=True)
    count = np.zeros(len(cost))
    for node in np.argsort(cost):
        if before[node] >= 0:
            count[node] = count[before[node]] + 1
    return count


def clearance_by_search(obstacle: Obstacle, starts: NDArray, ends: NDArray) -> NDArray:
    """Clearance `[k]` of segments by golden-section search on the convex signed distance."""
    low, high = np.zeros(len(starts)), np.ones(len(starts))
    golden = (np.sqrt(5) - 1) / 2

    def distance(t: NDArray) -> NDArray:
        return obstacle.signed_distance(starts + t[:, None] * (ends - starts))

    for _ in range(60):
        a, b = high - golden * (high - low), low + golden * (high - low)
        left = distance(a) < distance(b)
        high, low = np.where(left, b, high), np.where(left, low, a)
    return np.minimum(distance((low + high) / 2), np.minimum(distance(low), distance(high)))
