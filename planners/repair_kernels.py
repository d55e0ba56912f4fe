"""The numerical core of RRT^X: repair of the shortest-path tree after edges were blocked or freed.

Otte and Frazzoli, "RRT^X", International Journal of Robotics Research 35 (2016). Their symbols:
  g(v)     cost-to-go that the neighbours of v last heard of
  lmc(v)   look-ahead value, the cost-to-go through the best neighbour
  Q        queue of the inconsistent nodes, least (lmc, g) first
  epsilon  a node is consistent while g - lmc <= epsilon
Departures: an orphan looks for a new parent itself where the paper puts its neighbours back into
the queue, which has the same fixed point and needs fewer operations; and a batch of new nodes or of
edge changes is followed by one cascade. With epsilon = 0 the fixed point is Dijkstra's.
"""

import numpy as np
from numba import boolean, float64, int64, types

from ocp.compiled.jit import VECTOR, compiled

INDEX = types.Array(types.int64, 1, "C")
EDGES = types.Array(types.int64, 2, "C")
NODES = types.Array(types.int32, 1, "C")
FLAGS = types.Array(boolean, 1, "C")


@compiled(types.void(NODES, NODES, VECTOR, int64))
def _sift_up(heap, place, key, at):
    node = heap[at]
    while at > 0:
        above = (at - 1) // 2
        other = heap[above]
        if key[other] < key[node] or (key[other] == key[node] and other < node):
            break
        heap[at] = other
        place[other] = at
        at = above
    heap[at] = node
    place[node] = at


@compiled(types.void(NODES, NODES, VECTOR, int64, int64))
def _sift_down(heap, place, key, at, size):
    node = heap[at]
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        right = below + 1
        if right < size:
            a, b = heap[below], heap[right]
            if key[b] < key[a] or (key[b] == key[a] and b < a):
                below = right
        other = heap[below]
        if key[node] < key[other] or (key[node] == key[other] and node < other):
            break
        heap[at] = other
        place[other] = at
        at = below
    heap[at] = node
    place[node] = at


@compiled(types.void(NODES, NODES, INDEX, VECTOR, int64))
def _push(heap, place, size, key, node):
    """Insert the node, or move it up after its key fell."""
    if place[node] < 0:
        place[node] = size[0]
        heap[size[0]] = node
        size[0] += 1
    _sift_up(heap, place, key, place[node])


@compiled(types.void(NODES, NODES, INDEX, VECTOR, int64))
def _discard(heap, place, size, key, node):
    at = place[node]
    place[node] = -1
    size[0] -= 1
    if at == size[0]:
        return
    last = heap[size[0]]
    heap[at] = last
    place[last] = at
    _sift_up(heap, place, key, at)
    _sift_down(heap, place, key, place[last], size[0])


@compiled(types.void(NODES, NODES, NODES, NODES, int64))
def _leave(parent, child, following, previous, node):
    """Take the node out of its parent's list of children."""
    if parent[node] < 0:
        return
    if previous[node] >= 0:
        following[previous[node]] = following[node]
    else:
        child[parent[node]] = following[node]
    if following[node] >= 0:
        previous[following[node]] = previous[node]
    parent[node] = -1


@compiled(types.void(NODES, NODES, NODES, NODES, int64, int64))
def _join(parent, child, following, previous, node, to):
    """Make `node` a child of `to`."""
    _leave(parent, child, following, previous, node)
    head = child[to]
    parent[node] = to
    previous[node] = -1
    following[node] = head
    if head >= 0:
        previous[head] = node
    child[to] = node


TREE = (NODES, NODES, NODES, NODES)
QUEUE = (NODES, NODES, INDEX)
ROWS = (INDEX, INDEX, INDEX, NODES, VECTOR)


@compiled(int64(*ROWS, EDGES, INDEX, INDEX, VECTOR, VECTOR, *TREE, *QUEUE))
def block(
    start,
    both,
    into,
    target,
    weight,
    edges,
    slot,
    changed,
    g,
    lmc,
    parent,
    child,
    following,
    previous,
    heap,
    place,
    size,
):
    """Block the edges `changed` and orphan every node whose way to the goal used one.

    Each orphan takes the best neighbour that still has a parent and joins the queue.
    Returns the number of orphans.
    """
    n = g.shape[0]
    orphaned = np.zeros(n, dtype=np.bool_)
    orphans = np.empty(n, dtype=np.int64)
    count = 0
    for i in range(changed.shape[0]):
        e = changed[i]
        weight[slot[2 * e]] = weight[slot[2 * e + 1]] = np.inf
        u, v = edges[e, 0], edges[e, 1]
        lost = -1
        if parent[u] == v:
            lost = u
        elif parent[v] == u:
            lost = v
        if lost >= 0 and not orphaned[lost]:
            orphaned[lost] = True
            orphans[count] = lost
            count += 1
    i = 0
    while i < count:
        heir = child[orphans[i]]
        while heir >= 0:
            if not orphaned[heir]:
                orphaned[heir] = True
                orphans[count] = heir
                count += 1
            heir = following[heir]
        i += 1
    for i in range(count):
        node = orphans[i]
        if place[node] >= 0:
            _discard(heap, place, size, lmc, node)
        if parent[node] >= 0 and not orphaned[parent[node]]:
            _leave(parent, child, following, previous, node)
    for i in range(count):
        node = orphans[i]
        parent[node] = child[node] = following[node] = previous[node] = -1
        g[node] = lmc[node] = np.inf
    for i in range(count):
        node = orphans[i]
        best, foster = np.inf, -1
        for s in range(start[node], both[node]):
            u = target[s]
            if not orphaned[u] and weight[s] + lmc[u] < best:
                best, foster = weight[s] + lmc[u], u
        for s in range(into[node], start[node + 1]):
            u = target[s]
            if not orphaned[u] and weight[s] + lmc[u] < best:
                best, foster = weight[s] + lmc[u], u
        if foster >= 0:
            lmc[node] = best
            _join(parent, child, following, previous, node, foster)
            _push(heap, place, size, lmc, node)
    return count


@compiled(
    types.void(VECTOR, EDGES, INDEX, VECTOR, INDEX, float64, float64, VECTOR, VECTOR, *TREE, *QUEUE)
)
def free(
    weight,
    edges,
    slot,
    lengths,
    changed,
    cull_radius,
    epsilon,
    g,
    lmc,
    parent,
    child,
    following,
    previous,
    heap,
    place,
    size,
):
    """Free the edges `changed` and let both ends look along them."""
    for i in range(changed.shape[0]):
        e = changed[i]
        w = lengths[e]
        weight[slot[2 * e]] = weight[slot[2 * e + 1]] = w
        u, v = edges[e, 0], edges[e, 1]
        if lmc[v] > w + lmc[u]:
            lmc[v] = w + lmc[u]
            _join(parent, child, following, previous, v, u)
            if g[v] - lmc[v] > epsilon:
                _push(heap, place, size, lmc, v)
        elif w <= cull_radius and lmc[u] > w + lmc[v]:
            lmc[u] = w + lmc[v]
            _join(parent, child, following, previous, u, v)
            if g[u] - lmc[u] > epsilon:
                _push(heap, place, size, lmc, u)


@compiled(
    types.Tuple((int64, float64))(
        INDEX, INDEX, NODES, VECTOR, float64, VECTOR, VECTOR, *TREE, *QUEUE, VECTOR, boolean
    )
)
def cascade(
    start,
    into,
    target,
    weight,
    epsilon,
    g,
    lmc,
    parent,
    child,
    following,
    previous,
    heap,
    place,
    size,
    approach,
    to_the_end,
):
    """Rewiring cascade: make nodes consistent in the order of their look-ahead values.

    Args:
        approach: `[n]`, the robot's distance to each node it can go to straight, else infinite.
        to_the_end: go on after the robot's own cost-to-go is settled.

    Returns:
        the number of nodes made consistent, and the robot's cost-to-go.
    """
    robot = np.inf
    for v in range(g.shape[0]):
        robot = min(robot, approach[v] + lmc[v])
    done = 0
    while size[0] > 0:
        node = heap[0]
        if not to_the_end and lmc[node] >= robot:
            break
        _discard(heap, place, size, lmc, node)
        # g - lmc > epsilon for every queued node: the queue is entered only so, and lmc only falls.
        value = lmc[node]
        g[node] = value
        for s in range(start[node], into[node]):
            u = target[s]
            through = weight[s] + value
            if through < lmc[u]:
                lmc[u] = through
                _join(parent, child, following, previous, u, node)
                robot = min(robot, approach[u] + through)
                if g[u] - through > epsilon:
                    _push(heap, place, size, lmc, u)
        done += 1
    return done, robot


@compiled(types.Tuple((VECTOR, NODES, INDEX))(INDEX, INDEX, NODES, VECTOR, INDEX, int64))
def widest_ways(start, into, target, clearance, owner, root):
    """The way from every node to `root` whose least clearance is largest.

    Dijkstra's algorithm on max-min in place of min-plus.

    Args:
        clearance: `[m]` of each edge.
        owner: `[2 m]`, the edge of each half-edge.

    Returns:
        the width `[n]` of each node's widest way, its next node (-1 at the root), and the edge to
        it (-1 likewise).
    """
    n = start.shape[0] - 1
    key = np.full(n, np.inf)
    successor = np.full(n, -1, dtype=np.int32)
    along = np.full(n, -1, dtype=np.int64)
    heap = np.empty(n, dtype=np.int32)
    place = np.full(n, -1, dtype=np.int32)
    final = np.zeros(n, dtype=np.bool_)
    size = np.zeros(1, dtype=np.int64)
    key[root] = -np.inf
    _push(heap, place, size, key, root)
    while size[0] > 0:
        node = heap[0]
        _discard(heap, place, size, key, node)
        final[node] = True
        for s in range(start[node], into[node]):
            u = target[s]
            width = max(key[node], -clearance[owner[s]])
            if not final[u] and width < key[u]:
                key[u] = width
                successor[u] = node
                along[u] = owner[s]
                _push(heap, place, size, key, u)
    return -key, successor, along
