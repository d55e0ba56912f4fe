"""Input of planners and worlds, refused where it makes no sense."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def checked_box(
    lower: ArrayLike, upper: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners `[d]` of a box with an interior, as arrays.

    Raises:
        ValueError: if they do not fit each other, or leave no interior.
    """
    a, b = np.array(lower, dtype=float), np.array(upper, dtype=float)
    if a.ndim != 1 or a.shape != b.shape or not 2 <= len(a) <= 7:
        raise ValueError(
            "lower, upper: must be lists of the same 2 to 7 numbers of coordinates, "
            f"got shapes {a.shape} and {b.shape}"
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all() and (b > a).all()):
        raise ValueError(
            f"upper: must be finite and exceed lower, got {b.tolist()} over {a.tolist()}"
        )
    return a, b


def checked_padding(padding: float) -> float:
    """The padding, if it is a finite number of at least 0.

    Raises:
        ValueError: if it is not.
    """
    if not (np.isfinite(padding) and padding >= 0):
        raise ValueError(f"padding: must be a finite number of at least 0, got {padding}")
    return float(padding)


def checked_point(
    point: ArrayLike, lower: NDArray[np.float64], upper: NDArray[np.float64], name: str
) -> NDArray[np.float64]:
    """The point `[d]`, if it lies in the box between `lower` and `upper` `[d]`.

    Raises:
        ValueError: if it does not.
    """
    array = np.array(point, dtype=float)
    if array.shape != lower.shape:
        raise ValueError(f"{name}: must be {len(lower)} coordinates, got {array.tolist()}")
    if not ((array >= lower) & (array <= upper)).all():
        raise ValueError(
            f"{name}: must be finite and lie between {lower.tolist()} and "
            f"{upper.tolist()}, got {array.tolist()}"
        )
    return array
