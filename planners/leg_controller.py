"""What RRT-Q^X asks of whatever drives a leg: a controller of the error from a reference."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LegController(Protocol):
    """What drives a leg: it is handed errors x - x_r and answers with inputs.

    Law: while `forecast` gives an answer, the robot does what it foretells.
    """

    @property
    def ready(self) -> bool:
        """Whether the robot may be sent anywhere; before, it is being learned where it stands."""
        ...

    def new_leg(self) -> None:
        """The error is measured from another reference from now on; the horizon begins anew."""
        ...

    def control(self, error: Array) -> Array:
        """The input `[m]` to hold until the next sample, at the error `[n]`."""
        ...

    def forecast(self, errors: Array, receding: bool) -> Array | None:
        """Positions `[c, k, d]`, a sample a period from now on, relative to the reference.

        From errors `[c, n]`, up to (almost) standstill, as if a leg began now. With `receding` the
        horizon begins anew at every sample. `None` if the controller cannot tell.
        """
        ...
