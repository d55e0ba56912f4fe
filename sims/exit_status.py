"""How a command ends: exit statuses, and errors that are the user's to mend."""

from collections.abc import Iterator
from contextlib import contextmanager

BAD_INPUT, UNSOLVED = 2, 3


class BadInputError(Exception):
    """What the user gave is wrong; the message names the field, the value and what is right."""


@contextmanager
def reading_input() -> Iterator[None]:
    """Errors raised while input is read and checked are the user's to mend."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise BadInputError(str(error)) from error
