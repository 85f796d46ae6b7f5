"""The parts of the tracker against exact shifts, drawn noise and known faults of the picture."""

from __future__ import annotations

import numpy as np
import pytest
from film import FULL_WELL, READ_NOISE, Film, block_film, expose, moved, speckle

from frictrack.base.errors import FrictrackError
from frictrack.tracking import TargetModel, learn_target, track
from frictrack.tracking.measure import measure_frames, refine_robust, systematic_covariance
from frictrack.tracking.subpixel_fit import refine_positions, template_products
from frictrack.tracking.template import MAX_SHIFT_PX, fit_pattern, pattern_sums, shift_expansion
from frictrack.tracking.template_learning import learn_template, template_from_frame

SHAPE = (40, 56)
INSIDE = (slice(20, 60), slice(20, 76))  # of a texture of 80 x 96 px


def texture(seed=0, fwhm=4.0):
    return 128 + speckle((80, 96), np.random.default_rng(seed), fwhm=fwhm)


def frames(shift, seed=0, noise=True, **given):
    """The same window of the texture, moved by each shift (n, 2), and exposed."""
    rng = np.random.default_rng(seed + 100)
    pictures = [moved(texture(seed, **given), *s)[INSIDE] for s in shift]
    return np.stack([expose(p, rng if noise else None) for p in pictures])


def spread(n, seed=5):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 2))


def taught(shift, rounds=3, cuts=None, **given):
    cuts = frames(shift, **given) if cuts is None else cuts
    template = template_from_frame(cuts[0])
    fit = refine_positions(template_products(cuts, template), np.zeros((len(cuts), 2)), template)
    for _ in range(rounds):
        template = learn_template(cuts, fit, template)
        fit = refine_positions(template_products(cuts, template), fit.position, template)
    return cuts, fit, template


# ---- waves: every shift of a band-limited picture


def test_adjoint_is_the_transpose():
    grid, rng = shift_expansion(SHAPE), np.random.default_rng(1)
    waves = rng.standard_normal(grid.n_coefficients)
    pictures = rng.standard_normal((len(grid.order), *SHAPE))
    assert np.sum(grid.basis_images(waves) * pictures) == pytest.approx(
        np.sum(waves * grid.adjoint(pictures)), rel=1e-10
    )


@pytest.mark.parametrize("wave", [(0.05, 0.11), (0.3, 0.2), (0.35, 0.0)])
def test_shifts_of_a_wave_are_exact(wave):
    """A plane wave is not a sum of the cosines, but inside the picture it is met to a ten-thousandth."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def at(dx, dy):
        return np.sin(2 * np.pi * (wave[0] * (x - dx) + wave[1] * (y - dy)) + 0.3)

    template = template_from_frame(at(0, 0) * 100)
    inner = (slice(6, -6), slice(6, -6))
    for shift in ([0.5, 0.0], [-0.3, 0.45], [MAX_SHIFT_PX, -MAX_SHIFT_PX]):
        weights = template.shift_expansion.design(np.array([shift]))[0]
        picture = (weights @ template.basis_images[: weights.shape[1]]).reshape(SHAPE) + template.level
        np.testing.assert_allclose(picture[inner], 100 * at(*shift)[inner], atol=1.5)


def test_slopes_and_turn_are_derivatives():
    template = template_from_frame(texture()[INSIDE])
    k, step, shift = len(template.shift_expansion.order), 1e-5, np.array([[0.21, -0.34]])
    picture, along, across, turn = template.shift_expansion.design(shift)
    for axis, slope in ((0, along), (1, across)):
        ahead, behind = (template.shift_expansion.design(shift + s * np.eye(2)[axis])[0] for s in (step, -step))
        np.testing.assert_allclose((ahead - behind) / (2 * step), slope, atol=1e-6)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] - (np.array(SHAPE)[:, None, None] - 1) / 2
    turned = (turn @ template.basis_images[k:-1]).reshape(SHAPE)
    dx, dy = ((s @ template.basis_images[:k]).reshape(SHAPE) for s in (along, across))
    assert np.std(turned - (x * dy - y * dx)) < 0.05 * np.std(turned)  # of lower degree in the shift
    assert picture.shape == (1, k)


# ---- refine


def test_shift_gain_and_offset_of_exact_pictures():
    truth = spread(12)
    cuts = np.stack([40 + 0.8 * moved(texture(), *s)[INSIDE] for s in truth])
    _, _, template = taught(spread(60, 9), noise=False)
    fit = refine_positions(template_products(cuts, template), np.zeros((12, 2)), template)
    assert fit.converged.all()
    np.testing.assert_allclose(
        fit.position - truth, np.broadcast_to((fit.position - truth).mean(axis=0), (12, 2)), atol=4e-4
    )
    np.testing.assert_allclose(fit.gain / fit.gain.mean(), 1.0, rtol=2e-3)
    np.testing.assert_allclose(fit.score, 1.0, atol=1e-3)


def test_a_target_that_rotates_about_its_own_centre_keeps_its_place():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] - (np.array(SHAPE)[:, None, None] - 1) / 2

    def drawn(at, angle):
        dx, dy = x - at[0], y - at[1]
        u, v = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        return 128 + 60 * np.sin(0.5 * u + 0.2) * np.cos(0.4 * v + 0.1) * np.exp(-((u / 18) ** 4) - (v / 12) ** 4)

    at, angles = np.array([0.7, -0.4]), [-0.02, 0.0, 0.02]
    template = template_from_frame(drawn((0.0, 0.0), 0.0))
    cuts = np.stack([drawn(at, angle) for angle in angles])
    fit = refine_positions(template_products(cuts, template), np.zeros((3, 2)), template)
    np.testing.assert_allclose(fit.angle, angles, atol=2e-4)
    np.testing.assert_allclose(fit.position, np.broadcast_to(at, (3, 2)), atol=5e-4)  # about the cut-out: 0.014 px


def test_learnt_template_reaches_the_bound_and_says_so():
    truth = spread(400)
    _, fit, template = taught(truth)
    off = fit.position - truth
    off -= off.mean(axis=0)
    light = texture()[INSIDE]
    variance = (light / 255 * FULL_WELL + READ_NOISE**2) * (255 / FULL_WELL) ** 2 + 1 / 12
    wave = 2j * np.pi * np.fft.fftfreq(96)
    slope = np.fft.ifft(np.fft.fft(texture(), axis=1) * wave, axis=1).real[INSIDE]
    bound = 1 / np.sqrt(np.sum(slope**2 / variance))
    assert np.std(off[:, 0]) / bound == pytest.approx(1.0, abs=0.09)  # 400 errors scatter by 3.5 %
    assert np.mean(fit.sigma[:, 0]) / bound == pytest.approx(1.0, abs=0.03)
    assert np.median(1 / template.weight) == pytest.approx(np.median(variance), rel=0.08)
    assert np.median(fit.misfit) == pytest.approx(1.0, abs=0.05)


def test_pixels_that_come_and_go_count_little():
    truth = spread(120)
    cuts = frames(truth)
    cuts[:, 10:20, 30:44] = np.random.default_rng(3).integers(0, 255, (120, 10, 14))
    _, _, template = taught(truth, cuts=cuts)
    inside, outside = template.weight[11:19, 31:43], template.weight[24:, :]
    assert np.median(inside) < 0.01 * np.median(outside)


# ---- what stands before the target


def pass_by(change, n=300):
    """Sums over frames of a random scene that passes each pixel, and the picture's `change` of it."""
    rng = np.random.default_rng(2)
    noise = 1.5
    model = 40 * rng.standard_normal((n, 30, 50)).astype(np.float32)
    seen = change(model) + noise * rng.standard_normal(model.shape)
    difference = (seen - model).astype(np.float32)
    sums = pattern_sums((30, 50), np.zeros((n, 2), np.int64), model, difference, np.ones((30, 50)))
    return fit_pattern(sums, noise**2)


def test_nothing_in_the_way():
    assert pass_by(lambda m: m) is None


def test_flat_field_is_learnt():
    gain = 1 + 0.03 * np.random.default_rng(7).standard_normal((30, 50))
    view = pass_by(lambda m: gain * (m + 100) - 100)
    assert view is not None
    assert np.std(view.slope - gain) < 0.2 * 0.03
    assert np.std(view.level - 100 * (gain - 1)) < 0.3


def test_rod_and_highlight_are_learnt():
    def change(m):
        out = m.copy()
        out[:, :, 20:26] = 15.0
        out[:, 5:12, 35:44] += 50.0
        return out

    view = pass_by(change)
    assert view is not None
    assert np.all(view.share[:, 20:26] == 0)
    assert np.all(view.share[:, :20] == 1)
    np.testing.assert_allclose(view.level[5:12, 35:44], 50, atol=0.7)
    assert np.max(np.abs(view.level[:, :20])) < 0.5


# ---- what does not fit


def test_half_covered_target_is_measured_by_its_other_half():
    truth = spread(40, 11)
    cuts, fit, template = taught(np.concatenate([truth, spread(150, 12)]))
    covered = cuts[:40].copy()
    covered[:, :, :22] = 60
    plain = refine_positions(template_products(covered, template), np.zeros((40, 2)), template)
    better, _ = measure_frames(
        covered, np.zeros((40, 2), np.int64), fit[slice(0, 40)], TargetModel(template, typical_misfit=1.0)
    )
    level = (fit.position[40:] - spread(150, 12)).mean(axis=0)
    assert np.std(plain.position - truth) > 0.02
    assert np.std(better.position - truth - level) < 0.005
    assert better.converged.all()
    rated = (better.position - truth - level) / better.sigma[:, :2]
    assert np.sqrt(np.mean(rated**2)) == pytest.approx(1.0, abs=0.35)


def test_nothing_left_is_not_settled():
    _, fit, template = taught(spread(60))
    other = frames(spread(3), seed=44)
    got, _ = refine_robust(other, fit[slice(0, 3)], template)
    assert not np.any(got.converged & (got.score > 0.7) & (got.misfit < 4))


# ---- films of the same target


def test_a_known_target_needs_one_pass():
    x = 40 + 150 * (1 - np.exp(-np.arange(120) / 60))
    recording = block_film(x, size=(36, 48), shape=(64, 240))
    rect = [19, 17, 40, 30]
    model = learn_target(recording, rect)
    known, learnt = track(recording, rect, known=model), track(recording, rect)
    assert known.found.all()
    assert np.std(known.x_px - learnt.x_px) < 2e-4
    np.testing.assert_allclose(known.sigma_px, learnt.sigma_px, rtol=0.02)
    by_itself = track(block_film(x + 3.3, size=(36, 48), shape=(64, 240)), known=model)
    assert np.std(by_itself.x_px - x) < 0.005


def test_a_known_target_has_its_size():
    x = 40 + 1.5 * np.arange(60)
    recording = block_film(x, size=(36, 48), shape=(64, 240))
    model = learn_target(recording, [19, 17, 40, 30])
    with pytest.raises(FrictrackError, match="expected a target of the known 40x30 px but got 44x30 px"):
        track(recording, [17, 17, 44, 30], known=model)


def test_a_pattern_that_repeats_is_not_followed_one_period_off():
    """Dots every 12 px at 4 px a frame from a standing start in the picture: the next dot is never far."""
    y, x = np.mgrid[:64, :420]

    def draw(i):
        left = 20 + 3.9 * i
        dots = 128 + 60 * np.cos(2 * np.pi * (x - left) / 12) * np.cos(2 * np.pi * (y - 8) / 12)
        body = (x >= left) & (x < left + 72) & (y >= 8) & (y < 56)
        return expose(np.where(body, dots, 90.0), np.random.default_rng(i))

    result = track(Film(draw, 80, (64, 420)), [24, 10, 62, 44])
    assert result.found.all()
    assert np.std(result.x_px - 3.9 * np.arange(80)) < 0.01


# ---- what passes before the target

X = 60 + 280 * (1 - np.exp(-np.arange(180) / 90)) / (1 - np.exp(-2))


def glare(i, frame):
    """A reflection that goes along and drowns more than half of the target."""
    if 60 <= i < 80:
        frame[20:70, int(X[i]) - 5 : int(X[i]) + 60] = 255
    return frame


def hand(i, frame):
    """Something textured comes from behind and covers two thirds."""
    if 60 <= i < 80:
        x0, x1 = max(int(X[i]) - 60, 0), int(X[i]) + 10
        frame[:60, x0:x1] = 150 + 20 * np.random.default_rng(i).standard_normal((60, x1 - x0))
    return frame


def shadow(i, frame):
    """The edge of a shadow that stays on the target for a while."""
    if 60 <= i < 100:
        dark = 1 - 0.4 / (1 + np.exp(-(np.arange(frame.shape[1]) - X[i] - 10) / 4))
        frame = (frame * dark).astype(np.uint8)
    return frame


@pytest.mark.few(1)
@pytest.mark.parametrize("disturbed", [glare, hand, shadow])
def test_what_passes_before_the_target_neither_loses_nor_moves_it(disturbed):
    source = block_film(X, size=(40, 60), shape=(96, 400))
    pictures = [disturbed(i, source.frame(i).copy()) for i in range(len(X))]
    result = track(Film(lambda i: pictures[i], len(X), (96, 400)), [34, 32, 53, 33])
    off = result.x_px - X
    off -= np.nanmedian(off)
    assert result.found.all()
    assert np.std(off) < 0.004  # the bound of the clear film is 0.002 px
    assert np.max(np.abs(off)) < 0.02
    assert np.sqrt(np.mean((off / result.sigma_px) ** 2)) == pytest.approx(1.0, abs=0.25)


def changing(seed, n=160):
    """Frames over which a strip of light wanders, and their shifts."""
    truth, light, x = spread(n, seed + 7), np.random.default_rng(seed), np.arange(SHAPE[1])
    strips = (12 * np.exp(-(((x - 10 - 36 * k / n) / 6) ** 2)) for k in range(n))
    pictures = (moved(texture(seed), *s)[INSIDE] for s in truth)
    return np.stack([expose(p + strip, light) for p, strip in zip(pictures, strips, strict=True)]), truth


@pytest.mark.slow
def test_slow_errors_of_a_changing_look_are_stated():
    """The places' errors over twelfths of the film against what their residual pictures tell, six textures."""
    actual, stated = [], []
    for seed in range(6):
        cuts, truth = changing(seed)
        _, fit, template = taught(truth, cuts=cuts)
        off = fit.position - truth
        actual.append([part.mean(axis=0) for part in np.array_split(off - off.mean(axis=0), 12)])
        stated.append(np.diag(systematic_covariance(cuts, fit, template)))
    ratio = np.sqrt(np.mean(stated, axis=0) / np.mean(np.square(actual), axis=(0, 1)))
    assert np.all((ratio > 0.5) & (ratio < 1.5))
    assert np.sqrt(np.mean(np.square(actual))) > 2.5 * np.median(fit.sigma[:, :2])


def test_no_slow_error_where_the_look_does_not_change():
    for seed in range(3):
        truth = spread(160, seed)
        cuts, fit, template = taught(truth, seed=seed)
        assert not systematic_covariance(cuts, fit, template).any()
