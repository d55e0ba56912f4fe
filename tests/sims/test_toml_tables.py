"""Values of TOML tables: what passes, and how what does not is refused."""

import math

import pytest

from sims.toml_tables import number_of, positive


@pytest.mark.parametrize("value", [3, -0.5, math.inf])
def test_numbers_are_taken(value) -> None:
    assert number_of(value, "speed") == value


@pytest.mark.parametrize("value", [math.nan, True, "3", None, [1.0]])
def test_what_is_no_number_is_refused(value) -> None:
    with pytest.raises(ValueError, match=r"^speed: must be a number, got"):
        number_of(value, "speed")


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_only_positive_finite_numbers_are_positive(value) -> None:
    with pytest.raises(ValueError, match=r"^speed: must be positive and finite, got"):
        positive(value, "speed")
