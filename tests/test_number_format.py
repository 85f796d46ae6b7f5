"""Numbers as text: every form that the report, the figures and the terminal use."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictrack.base.number_format import (
    format_change,
    format_interval,
    format_number,
    format_plain,
    format_plus_minus,
    format_quantity,
    format_range,
    format_size,
    format_unit,
)

MINUS, THIN = "\N{MINUS SIGN}", "\N{NARROW NO-BREAK SPACE}"


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.9594, 3, "0.959"),
        (0.9999, 3, "1.00"),
        (12.0, 2, "12"),
        (-3.14159, 2, f"{MINUS}3.1"),
        (None, 3, "–"),
        (math.nan, 3, "–"),
        (0.0, 2, "0"),
        (12345.0, 3, f"12{THIN}345"),
        (0.00213, 3, "0.00213"),
        (-2.5, 3, f"{MINUS}2.50"),
        (3.2e8, 3, f"3.20{THIN}×{THIN}10⁸"),
        (1.5e-7, 2, f"1.5{THIN}×{THIN}10⁻⁷"),
    ],
)
def test_a_number_keeps_its_significant_digits(value, digits, text):
    assert format_number(value, digits) == text


def test_a_missing_number_reads_as_asked():
    assert format_number(None, missing="unknown") == "unknown"
    assert format_plain(None) == "-"


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (8.0123, 0.021, "N", "8.01 ± 0.02 N"),
        (8.0123, 0.0194, "N", "8.012 ± 0.019 N"),
        (38799.0, 1385.0, "N", "38800 ± 1400 N"),
        (0.25, 0.096, "1", "0.25 ± 0.10"),
        (None, None, "N", "not determined"),
        (0.5, 0.0, "m/s", "0.5 m/s"),
        (0.5, math.inf, "m/s", "0.5 m/s"),
        (0.00123, 0.00002, "m", "1.23 ± 0.02 mm"),
        (-2.5, 0.3, "N s/m", f"({MINUS}2.5 ± 0.3) N s/m"),
        (8.0123, 0.0961, "N", "8.01 ± 0.10 N"),
        (8.0123, 0.149, "N", "8.01 ± 0.15 N"),
        (8.0123, 0.1961, "N", "8.0 ± 0.2 N"),
        (0.030005, 0.0000107, "m", "30.005 ± 0.011 mm"),
        (2.3e-5, 4e-6, "m", "23 ± 4 µm"),
        (1.20055, 0.0005, "N s/m", "(1.2006 ± 0.0005) N s/m"),
        (-0.62, 0.03, "rad", f"{MINUS}0.62 ± 0.03 rad"),
        (123.4, 26.0, "Hz", "123 ± 26 Hz"),
        (1.0, 0.0, "1", "1"),
        (9.2e-6, 1e-7, "1/m^2", f"(9.20 ± 0.10){THIN}×{THIN}10⁻⁶ 1/m²"),
        (3.0e7, 2.0e5, "N/m", f"(3.00 ± 0.02){THIN}×{THIN}10⁷ N/m"),
    ],
)
def test_a_quantity_ends_where_its_standard_deviation_ends(value, std, unit, text):
    assert format_quantity(value, std, unit) == text


def test_the_terminal_keeps_two_digits_of_the_standard_deviation():
    assert format_plus_minus(812.3, 12.3) == "812 ± 12"
    assert format_plus_minus(1.2345e-9, 1e-11) == "1.2345e-09 ± 1e-11"


def test_sizes_ranges_and_units():
    assert format_size(2.0e-5, "m") == "20 µm"
    assert format_interval(None) == "–"
    assert format_range([3.0]) == "3.0"
    assert format_change(12345.4) == f"+12{THIN}345"
    assert format_unit("N s^2/m^2") == "N s²/m²"


@given(st.floats(1e-8, 1e8), st.floats(1e-6, 10.0))
def test_the_rounding_loses_less_than_a_third_of_the_standard_deviation(value, relative):
    """Half of the second digit is at most 0.05 of a deviation; the value keeps at least five digits."""
    std = value * relative
    rounded = float(format_plus_minus(value, std).partition(" ")[0])
    assert abs(rounded - value) <= 0.3 * std + 1e-4 * value
