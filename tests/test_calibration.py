"""Pixels to metres, and text to quantities, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.base.units import parse_quantity
from frictrack.measure.calibration import calibrate, parse_scale
from frictrack.measure.friction import friction
from frictrack.records import Displacement, Motion, Run, Track


def a_track(x, y, lost=(), **given):
    n = len(x)
    gap = np.zeros(n)
    gap[list(lost)] = np.nan
    columns = dict(angle=0.01, sigma_px=0.002, sigma_y_px=0.004, score=0.99)
    columns = {k: np.full(n, v) + gap for k, v in columns.items()}
    reason = np.where(np.isnan(gap), "gone", "")
    return Track(t=np.arange(n) / 4000, x_px=x + gap, y_px=y + gap, reason=reason, **columns, **given)


SQUARE = [[0, 0], [100, 0], [100, 100], [0, 100]]
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
    got = parse_quantity(text, unit, "the thing")
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
        parse_quantity(text, "kg", "mass")


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
        ("0 mm/px", "expected the scale above 0 m/px but got '0 mm/px'"),
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
    """What noise there is beside the shake is that of rounding."""
    n = np.arange(400)
    shake = 0.3 * np.sin(0.2 * n)
    x, y = 100.0 + n, 50.0 - 0.1 * n
    reference = a_track(400 + shake, 20 - shake, name="base", notes=("base shakes",))
    d = calibrate(a_track(x + shake, y - shake), 1.0, reference=reference)
    np.testing.assert_allclose(d.x - d.x[0], n, atol=2e-3)
    np.testing.assert_allclose(d.y - d.y[0], 0.1 * n, atol=2e-3)
    assert np.all((d.sigma_x > 0.002) & (d.sigma_x < 0.0021))
    assert d.notes[0] == "base shakes"
    assert d.notes[1].startswith("camera shake of 0.21 px along x")


def test_lost_frames_stay_lost():
    """A reference that was lost takes frames away only where it has something to tell."""
    n = np.arange(40)
    still = a_track(400 + 0 * n, 20 + 0 * n, lost=[2])
    d = calibrate(a_track(100.0 + n, 50.0 - n, lost=[1]), 1.0, reference=still)
    assert np.flatnonzero(~d.valid).tolist() == [1]
    swaying = a_track(400 + np.sin(n), 20 + 0 * n, lost=[2])
    d = calibrate(a_track(100.0 + n, 50.0 - n, lost=[1]), 1.0, reference=swaying)
    for column in (d.x, d.y, d.sigma_x, d.sigma_y, d.angle):
        assert np.flatnonzero(np.isnan(column)).tolist() == [1, 2]


@pytest.mark.parametrize("axis", [[0, 0], [1], [np.nan, 1]])
def test_axis_that_is_none(axis):
    with pytest.raises(FrictrackError, match="expected the course axis as"):
        calibrate(a_track(X, Y), 1.0, axis=axis)


def test_reference_that_cannot_serve():
    with pytest.raises(FrictrackError, match='the reference "base" was found in no frame'):
        calibrate(a_track(X, Y), 1.0, reference=a_track(X, Y, lost=[0, 1, 2], name="base"))
    with pytest.raises(FrictrackError, match="expected a reference track of 3 frames but got 2"):
        calibrate(a_track(X, Y), 1.0, reference=a_track(X[:2], Y[:2]))


# ---- direction of the course


def a_slide(angle=0.0, bend=0.0, sigma=0.002, n=400, seed=0, length=300.0):
    """A track of some px along a line (deg, up in the picture) that bends (deg from end to end)."""
    rng = np.random.default_rng(seed)
    s = length * np.linspace(0, 1, n) ** 0.7
    off = np.radians(bend) / (2 * length) * (s - length / 2) ** 2
    a = np.radians(angle)
    x, y = 100 + s * np.cos(a) - off * np.sin(a), 300 - s * np.sin(a) - off * np.cos(a)
    return a_track(x + rng.normal(0, sigma, n), y + rng.normal(0, sigma, n))


def test_a_course_off_the_axis_is_told_with_its_price():
    notes = calibrate(a_slide(3.0), 5e-4).notes
    assert len(notes) == 1
    assert notes[0].startswith("the path runs 3.0° ± 0.0")
    assert "off the picture's axis, so that displacement and force come out 0.14 % too small (1 - cos)" in notes[0]
    assert calibrate(a_slide(0.9), 5e-4).notes == ()
    assert calibrate(a_slide(3.0), 5e-4, axis=[np.cos(np.radians(3)), -np.sin(np.radians(3))]).notes == ()


def test_a_bent_course_is_told():
    notes = calibrate(a_slide(0.0, bend=6.0), 5e-4).notes
    assert any(n.startswith("the path bends by 6.0° from end to end") for n in notes)
    assert calibrate(a_slide(0.0, bend=0.5), 5e-4).notes == ()


@pytest.mark.parametrize("angle", [-80, -50, -3, 0, 7, 45, 178, 222])
def test_the_axis_of_the_track(angle):
    """Along the path itself displacement is whole; +x is right, or down where the path is steep."""
    track = a_slide(angle)
    d = calibrate(track, 5e-4, axis="track")
    direction = np.array([np.cos(np.radians(angle)), -np.sin(np.radians(angle))])  # in the picture, y down
    steep = abs(direction[1]) > np.tan(np.radians(60)) * abs(direction[0])
    assert np.sign(d.x[-1] - d.x[0]) == np.sign(direction[1] if steep else direction[0])
    assert np.ptp(d.x) == pytest.approx(300 * 5e-4, rel=1e-4)
    assert np.std(d.y) < 1.3 * 0.002 * 5e-4
    assert "x follows the path, whose direction is known to" in d.notes[0]


def test_runs_in_both_directions_share_the_axis_of_the_track():
    there, back = (calibrate(a_slide(angle), 5e-4, axis="track") for angle in (4, 184))
    assert there.x[-1] > there.x[0]
    assert back.x[-1] < back.x[0]


def test_the_angle_of_the_track_is_as_sure_as_stated():
    from frictrack.measure.calibration.displacement import fit_path  # noqa: PLC0415

    z = []
    for seed in range(200):
        t = a_slide(2.0, sigma=0.05, n=200, seed=seed)
        line = fit_path(np.stack([t.x_px, t.y_px], axis=1), np.full(200, 0.05))
        angle = np.arctan2(-line.direction[1], line.direction[0])
        z.append((np.mod(angle + np.pi / 2, np.pi) - np.pi / 2 - np.radians(2.0)) / line.std)
    assert 0.85 < np.sqrt(np.mean(np.square(z))) < 1.15


def test_a_few_wild_frames_do_not_turn_the_axis():
    track = a_slide(4.0)
    wild = track.y_px.copy()
    wild[50:70] += 30.0
    d = calibrate(a_track(track.x_px, wild), 5e-4, axis="track")
    steady = calibrate(track, 5e-4, axis="track")
    assert np.ptp(d.x) == pytest.approx(np.ptp(steady.x), rel=1e-3)


def test_no_axis_without_a_path():
    with pytest.raises(FrictrackError, match='expected a target that travels for axis = "track" but it rests'):
        calibrate(a_slide(length=0.01), 5e-4, axis="track")
    with pytest.raises(FrictrackError, match=r'expected the course axis as \[dx, dy\] px or "track" but got \'along\''):
        calibrate(a_slide(), 5e-4, axis="along")
    with pytest.raises(FrictrackError, match="expected a target that is found but it is lost in every frame"):
        calibrate(a_track(X, Y, lost=[0, 1, 2]), 5e-4)


# ---- what the scale is worth


def test_the_error_of_the_scale_is_that_of_the_length_of_the_path():
    """Clicks of 0.5 px on a ruler of 100 px: 0.7 %, along with the length's own; z over draws of the clicks."""
    rng = np.random.default_rng(0)
    z = []
    for _ in range(300):
        clicks = np.array([[50.0, 80.0], [150.0, 80.0]]) + rng.normal(0, 0.5, (2, 2))
        length = 0.05 * (1 + rng.normal(0, 0.004))
        d = calibrate(a_slide(), {"points": clicks.tolist(), "length": f"{1e3 * length} +/- 0.2 mm"})
        z.append((np.ptp(d.x) / (300 * 5e-4) - 1) / d.relative_scale_error)
    assert d.relative_scale_error == pytest.approx(np.hypot(0.5 * np.sqrt(2) / 100, 0.004), rel=0.02)
    assert 0.9 < np.sqrt(np.mean(np.square(z))) < 1.1


def test_a_short_ruler_is_told():
    short = {"points": [[50, 80], [100, 80]], "length": "25 mm"}
    notes = calibrate(a_slide(), short).notes
    assert notes[0].startswith("scale by a ruler of 25 mm over 50 px, clicked to 0.5 px: 500 µm/px")
    assert "the scale was read over 50 px but the path is 300 px long" in notes[1]
    long = {"points": [[50, 80], [350, 80]], "length": "150 mm"}
    assert len(calibrate(a_slide(), long).notes) == 1


def test_two_scales_that_disagree():
    ruler = {"points": [[50, 80], [350, 80]], "length": "150 mm"}
    assert calibrate(a_slide(), ["0.500 +/- 0.001 mm/px", ruler]).notes == ()
    notes = calibrate(a_slide(), ["0.510 +/- 0.001 mm/px", ruler]).notes
    assert notes[0].startswith("two scales disagree: 500 µm/px (scale by a ruler of 150 mm over 300 px")
    assert "is -2 % off the 510 µm/px that is used, and their standard deviation is 0.31 %" in notes[0]


def test_perspective_is_undone_and_told():
    """A plane whose pitch doubles over 400 px: X = u / (800 - u) is a homography of the picture."""
    u, v = np.meshgrid([50.0, 450.0], [50.0, 350.0])
    points = np.stack([u.ravel(), v.ravel()], axis=1)

    def places(p):
        return np.stack([p[:, 0], p[:, 1]], axis=1) / (800 - p[:, :1])

    track = a_slide()
    d = calibrate(track, {"points": points.tolist(), "plane": places(points).tolist()})
    at = places(np.stack([track.x_px, track.y_px], axis=1))
    middle = np.array([[250.0, 200.0]])
    slope = (places(middle + np.array([[1e-3, 0.0]])) - places(middle))[0]
    along = slope / np.hypot(*slope)
    np.testing.assert_allclose(d.x, at @ along, atol=1e-9)
    i = len(track) // 2  # the deviation follows the local pitch
    step = (places([[track.x_px[i] + 1e-3, track.y_px[i]]] * np.ones((1, 2))) - at[i])[0] @ along / 1e-3
    other = (places([[track.x_px[i], track.y_px[i] + 1e-3]] * np.ones((1, 2))) - at[i])[0] @ along / 1e-3
    assert d.sigma_x[i] == pytest.approx(np.hypot(0.002 * step, 0.004 * other), rel=1e-3)
    assert any("along the path (perspective and lens), which is undone" in n for n in d.notes)
    assert d.notes[0].startswith("scale by 4 points of known place, clicked to 0.5 px")


def test_a_track_beyond_the_horizon():
    points = [[50, 50], [450, 50], [450, 350], [50, 350]]
    places = [[x / (500 - x), y / (500 - x)] for x, y in points]
    with pytest.raises(FrictrackError, match=r"the calibration cannot place .* of 400 frames on the plane: they lie"):
        calibrate(a_slide(length=600.0), {"points": points, "plane": places})


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        ({}, "expected a scale as"),
        ({"colour": "red"}, "expected a scale as .* but got the keys colour"),
        ({"points": SQUARE, "plane": SQUARE, "length": "1 m"}, "scale by points with the keys .* but got length too"),
        ({"target": "40 mm", "click": "1 px"}, "expected a scale by target with the keys target but got click too"),
        ({"board": "b.png"}, "expected a scale by board with .* but 'square' and 'squares' is missing"),
        ({"points": [[1, 1], [2, 2], [3, 3]], "length": "1 m"}, "expected two points"),
        ({"points": [[1, 1], [2, 2]], "length": "-1 m"}, "expected the length between the two points above 0 m"),
        ({"points": [[1, 1], [2, 2]], "length": "1 m", "click": "far"}, "a click,"),
        ([], "expected the scale as a quantity in m/px"),
        ([5e-4, "heavy"], "expected the scale as a quantity in m/px"),
    ],
)
def test_scales_that_are_none(scale, said):
    with pytest.raises(FrictrackError, match=said) as caught:
        parse_scale(scale)
    assert "\n" not in str(caught.value)


# ---- what it does to forces


def test_the_scale_reaches_the_force():
    """m a of 0.35 kg at 10 m/s^2 with a scale known to 1 %: 35 mN, and the same in every frame."""
    t = np.arange(200) / 1000
    nan = np.full(200, np.nan)
    x = 2 * t - 5.0 * t**2
    seen = Displacement(
        t, x, nan, nan, np.full(200, 1e-6), nan, np.ones(200, bool), pixel_pitch=1e-4, relative_scale_error=0.01
    )
    tiny = np.full(200, 1e-9)
    motion = Motion(t, x, 2 - 10 * t, np.full(200, -10.0), nan, tiny, tiny, tiny, nan)
    known = friction(Run(seen, motion, mass=0.35, free=(0.01, 0.15)))
    np.testing.assert_allclose(known.sigma_F, 0.035, rtol=1e-6)
