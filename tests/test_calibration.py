"""Pixels to metres, and text to quantities, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.calibration import calibrate, parse_scale
from frictrack.errors import FrictrackError
from frictrack.records import Track
from frictrack.units import quantity


def a_track(x, y, lost=(), **given):
    n = len(x)
    gap = np.zeros(n)
    gap[list(lost)] = np.nan
    columns = dict(angle=0.01, sigma_px=0.002, sigma_y_px=0.004, score=0.99)
    columns = {k: np.full(n, v) + gap for k, v in columns.items()}
    reason = np.where(np.isnan(gap), "gone", "")
    return Track(t=np.arange(n) / 4000, x_px=x + gap, y_px=y + gap, reason=reason, **columns, **given)


X, Y = np.array([100.0, 110.0, 130.0]), np.array([50.0, 49.0, 47.0])


# ---- quantities


@pytest.mark.parametrize(
    ("text", "unit", "value", "std"),
    [
        ("0.35 kg", "kg", 0.35, 0.0),
        ("0.35kg", "kg", 0.35, 0.0),
        ("350 +/- 2 g", "kg", 0.35, 0.002),
        ("(350 ± 2) g", "kg", 0.35, 0.002),
        ("0.350 +/- 1% kg", "kg", 0.35, 0.0035),
        (0.35, "kg", 0.35, 0.0),
        (np.float32(0.5), "kg", 0.5, 0.0),
        ("0.35", "kg", 0.35, 0.0),
        ("0.5 mm/px", "m/px", 5e-4, 0.0),
        ("2 px/mm", "px/m", 2000.0, 0.0),
        ("-90 deg", "rad", -np.pi / 2, 0.0),
        ("1e-3 N/um", "N/m", 1000.0, 0.0),
        ("3 kHz", "Hz", 3000.0, 0.0),
    ],
)
def test_quantity(text, unit, value, std):
    got = quantity(text, unit, "the thing")
    assert got == pytest.approx((value, std), rel=1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0.35 kgs/parsnip", 'expected mass as a quantity in kg but got the unknown unit "kgs/parsnip"; write it like'),
        ("0.35 mm", 'but got "mm", which measures something else; write it like "0.350 \\+/- 0.002 kg"'),
        ("heavy", 'expected mass as a quantity in kg but got "heavy"'),
        ("0.35 +/- -1 kg", "expected an uncertainty of mass above 0"),
        (True, "expected mass as a quantity in kg but got True"),
        ([1], r"expected mass as a quantity in kg but got \[1\]"),
        (float("nan"), "expected mass as a quantity in kg but got nan"),
        ("0.35 kg kg) (", "expected mass as a quantity in kg but got"),
    ],
)
def test_no_quantity(text, said):
    with pytest.raises(FrictrackError, match=said):
        quantity(text, "kg", "mass")


# ---- scale


@pytest.mark.parametrize(
    ("scale", "pitch", "relative"),
    [
        ("0.5 mm/px", 5e-4, 0.0),
        ("0.500 +/- 0.002 mm/px", 5e-4, 0.004),
        (5e-4, 5e-4, 0.0),
        ({"points": [[10, 10], [40, 50]], "length": "100 mm"}, 2e-3, np.sqrt(2) * 0.5 / 50),
        ({"points": [[10, 10], [40, 50]], "length": "100 +/- 1 mm"}, 2e-3, np.hypot(0.01, np.sqrt(2) * 0.5 / 50)),
        ({"points": [[10, 10], [40, 50]], "length": "100 +/- 1 mm", "click": "1e-9 px"}, 2e-3, 0.01),
    ],
)
def test_parse_scale(scale, pitch, relative):
    assert parse_scale(scale) == pytest.approx((pitch, relative))


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (None, 'expected a scale but got none; give scale = "0.5 mm/px"'),
        ("0 mm/px", "expected a scale above 0 m/px but got 0 m/px"),
        ("0.5 mm", "expected the scale as a quantity in m/px but got"),
        ({"points": [[1, 1], [1, 1]], "length": "1 m"}, "expected two different points"),
        ({"points": [[1, 1]], "length": "1 m"}, "expected two points"),
        ({"points": "here", "length": "1 m"}, "expected points as"),
        ({"points": [[1, 1], [2, 2]]}, "'length' is missing"),
    ],
)
def test_no_scale(scale, said):
    with pytest.raises(FrictrackError, match=said):
        parse_scale(scale)


# ---- calibrate


def test_default_axis_is_image_right_and_up():
    d = calibrate(a_track(X, Y, notes=("seen",)), "0.500 +/- 0.002 mm/px")
    np.testing.assert_allclose(d.x, X * 5e-4)
    np.testing.assert_allclose(d.y, -Y * 5e-4)  # image y is down
    np.testing.assert_allclose(d.sigma_x, 0.002 * 5e-4)
    np.testing.assert_allclose(d.sigma_y, 0.004 * 5e-4)
    np.testing.assert_allclose(d.angle, -0.01)  # clockwise on the screen
    assert d.pixel_pitch == pytest.approx(5e-4)
    assert d.relative_scale_error == pytest.approx(0.004)
    assert d.notes == ("seen",)


def test_origin_and_offset():
    d = calibrate(a_track(X, Y), 5e-4, origin_px=[100, 50], x_offset=0.2)
    np.testing.assert_allclose(d.x, 0.2 + np.array([0, 10, 30]) * 5e-4)
    np.testing.assert_allclose(d.y, np.array([0, 1, 3]) * 5e-4)


@pytest.mark.parametrize("degrees", [0, 20, 90, 135, 180, -22, -135])
def test_course_in_any_direction(degrees):
    """A body that moves s along the course and h above it is found at s, h, whichever way the course runs."""
    along = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    up = np.array([along[1], -along[0]])
    up = up if up[1] <= 0 else -up
    s, h = np.array([0.0, 3.0, 7.0]), np.array([1.0, -2.0, 0.5])
    at = s[:, None] * along + h[:, None] * up
    d = calibrate(a_track(at[:, 0], at[:, 1]), 1.0, axis=7 * along)
    np.testing.assert_allclose(d.x, s, atol=1e-12)
    np.testing.assert_allclose(d.y, h, atol=1e-12)
    expected = np.hypot(0.002 * along[0], 0.004 * along[1])
    np.testing.assert_allclose(d.sigma_x, expected)


def test_reference_takes_the_shake_off():
    shake = np.array([0.3, -0.2, 0.0])
    reference = a_track(400 + shake, 20 - shake, name="base", notes=("base shakes",))
    d = calibrate(a_track(X + shake, Y - shake), 1.0, reference=reference)
    np.testing.assert_allclose(d.x, X)
    np.testing.assert_allclose(d.y, -Y)
    np.testing.assert_allclose(d.sigma_x, np.sqrt(2) * 0.002)
    assert d.notes == ("base shakes",)


def test_lost_frames_stay_lost():
    d = calibrate(a_track(X, Y, lost=[1]), 1.0, reference=a_track(X, Y, lost=[2]))
    assert d.valid.tolist() == [True, False, False]
    for column in (d.x, d.y, d.sigma_x, d.sigma_y, d.angle):
        assert np.isnan(column).tolist() == [False, True, True]


@pytest.mark.parametrize("axis", [[0, 0], [1], [np.nan, 1]])
def test_axis_that_is_none(axis):
    with pytest.raises(FrictrackError, match="expected the course axis as"):
        calibrate(a_track(X, Y), 1.0, axis=axis)


def test_reference_that_cannot_serve():
    with pytest.raises(FrictrackError, match='the reference "base" was found in no frame'):
        calibrate(a_track(X, Y), 1.0, reference=a_track(X, Y, lost=[0, 1, 2], name="base"))
    with pytest.raises(FrictrackError, match="expected a reference track of 3 frames but got 2"):
        calibrate(a_track(X, Y), 1.0, reference=a_track(X[:2], Y[:2]))
