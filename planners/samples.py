"""Where nodes are put: a Halton sequence with a random shift.

Points of low dispersion cover the box more evenly than independent ones; ways on the same number of
nodes come out shorter (Janson, Ichter and Pavone, International Journal of Robotics Research 37,
2018). The shift (Cranley and Patterson, 1976) makes seeds differ.
"""

import numpy as np
from numpy.typing import NDArray

PRIMES = (2, 3, 5, 7, 11, 13, 17)


class Samples:
    """The unit box's points, one after the other."""

    def __init__(self, dimension: int, seed: int) -> None:
        """Samples of up to seven dimensions; equal seeds give equal points."""
        self._bases = PRIMES[:dimension]
        self._shift = np.random.default_rng(seed).uniform(size=dimension)
        self._taken = 0

    def take(self, count: int) -> NDArray[np.float64]:
        """The next `[count, d]` points, in [0, 1)."""
        index = np.arange(self._taken + 1, self._taken + count + 1)
        self._taken += count
        columns = [radical_inverse(index, base) for base in self._bases]
        return (np.stack(columns, axis=1) + self._shift) % 1.0


def radical_inverse(index: NDArray[np.int64], base: int) -> NDArray[np.float64]:
    """The digits of `index` `[k]` in this base, mirrored at the point."""
    rest, result, weight = index.copy(), np.zeros(len(index)), 1.0
    while rest.any():
        rest, digit = np.divmod(rest, base)
        weight /= base
        result += weight * digit
    return result
