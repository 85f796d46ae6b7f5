"""The tracker on films of known truth, against the Cramer-Rao bound, and what it says when it cannot know."""

from __future__ import annotations

import film
import numpy as np
import pytest
from film import Film, block_film, expose, speckle
from scipy.ndimage import map_coordinates

from frictrack.base.errors import FrictrackError
from frictrack.tracking import target_line, track

SIZE, SHAPE = (36, 48), (64, 240)  # of the block and the picture, px
N = 80
SLIDE = 40 + 150 * (1 - np.exp(-np.arange(N) / 40))


def a_film(x, change=None, **given):
    """The block film, drawn once; `change(i, frame)` may spoil frames."""
    source = block_film(np.asarray(x), size=SIZE, shape=SHAPE, **given)
    frames = [source.frame(i) for i in range(len(source))]
    if change:
        frames = [change(i, frame.copy()) for i, frame in enumerate(frames)]
    return Film(lambda i: frames[i], len(frames), frames[0].shape)


def error(result, x):
    """Error of the track in px, constant offset removed."""
    off = result.x_px - x
    return off - np.nanmean(off)


def rectangle(x, inside=3):
    """The block's rectangle when its centre is at x, some pixels inside its edge."""
    left, top = int(np.ceil(x - SIZE[1] / 2)) + inside, (SHAPE[0] - SIZE[0]) // 2 + inside
    return [left, top, SIZE[1] - 2 * inside - 1, SIZE[0] - 2 * inside]


def bound(rect, texture_seed=0):
    """Cramer-Rao bound of x in px for the noise of `film.expose`: texture known; y, gain and offset free."""
    texture = speckle((SIZE[0] + 36, SIZE[1] + 38), np.random.default_rng(texture_seed))
    inside = (slice(4, 4 + rect[3]), slice(4, 4 + rect[2]))
    columns = [texture, np.ones_like(texture)]
    for axis in (1, 0):
        q = 2j * np.pi * np.fft.fftfreq(texture.shape[axis])
        slope = np.fft.fft(texture, axis=axis) * (q if axis else q[:, None])
        columns.insert(0, np.fft.ifft(slope, axis=axis).real)
    variance = ((128 / 255 * film.FULL_WELL) + film.READ_NOISE**2) * (255 / film.FULL_WELL) ** 2 + 1 / 12
    design = np.stack([c[inside].ravel() for c in columns], axis=1)
    return np.sqrt(variance * np.linalg.inv(design.T @ design)[1, 1])  # columns: y, x, texture, one


# ---- accuracy


def test_error_is_at_the_noise_bound_and_sigma_says_so():
    rect = rectangle(SLIDE[0], inside=4)
    errors, sigmas = [], []
    for seed in range(3):
        result = track(a_film(SLIDE, seed=seed), rect)
        assert result.found.all()
        errors.append(error(result, SLIDE) / bound(rect, seed))
        sigmas.append(result.sigma_px / bound(rect, seed))
    # 240 errors scatter by 5 %; 1.00 is the floor of every estimator.
    assert np.sqrt(np.mean(np.square(errors))) < 1.12
    assert np.mean(sigmas) == pytest.approx(1.0, abs=0.06)


def test_no_peak_locking_without_noise():
    x = 60 + np.arange(N) * 1.0371
    result = track(a_film(x, noise=False), rectangle(x[0]))
    assert np.max(np.abs(error(result, x))) < 1.5e-3  # rounding to whole grey values alone leaves 0.4 mpx


def test_both_axes():
    y = 31.5 + 2 * np.sin(np.arange(N) / 9)
    result = track(a_film(SLIDE, y=y))
    off = result.y_px - y
    off -= off.mean()  # the rectangle's middle need not be the block's
    assert np.std(off) < 0.005
    assert np.std(off / result.sigma_y_px) == pytest.approx(1.0, abs=0.25)


def test_flicker_and_drifting_light_do_not_move_the_target():
    light = 1 + 0.1 * np.sin(np.arange(N)) - 0.2 * np.arange(N) / N
    result = track(a_film(SLIDE, light=light))
    assert np.std(error(result, SLIDE)) < 0.004


def test_background_inside_the_rectangle_does_not_drag_the_target_along():
    x = 60 + np.arange(N) * 0.31
    generous = [x - 7 for x in rectangle(x[0])[:2]] + [v + 14 for v in rectangle(x[0])[2:]]
    off = error(track(a_film(x), generous), x)
    assert np.std(off) < 0.0035
    assert abs(np.polyfit(x, off, 1)[0]) < 3e-4  # px of error per px of travel


def test_bit_depth_of_twelve():
    source = block_film(SLIDE, size=SIZE, shape=SHAPE, noise=False)
    deep = Film(lambda i: source.frame(i).astype(np.uint16) * 16 + 5, N, SHAPE, bit_depth=12)
    assert np.std(error(track(deep), SLIDE)) < 0.002


def turning_film(angle):
    """A large speckle picture turned about its centre by angle (n,), rad; read off a four times finer grid."""
    fine, size = 4, 96
    texture = 128 + speckle((size * fine * 2,) * 2, np.random.default_rng(1), fwhm=4.5 * fine)
    y, x = np.mgrid[:64, :120].astype(float)
    centre = (59.5, 31.5)

    def draw(i):
        c, s = np.cos(angle[i]), np.sin(angle[i])
        dx, dy = x - centre[0], y - centre[1]
        at = np.stack([-s * dx + c * dy, c * dx + s * dy]) * fine + size * fine
        return expose(map_coordinates(texture, at, order=3), np.random.default_rng([4, i]))

    return Film(draw, len(angle), (64, 120))


def test_small_rotation_is_seen_and_leaves_the_position_alone():
    angle = np.radians(0.3) * np.sin(np.arange(30) / 4)
    result = track(turning_film(angle), [30, 10, 60, 44])
    found = result.angle - np.mean(result.angle)
    assert np.std(found - (angle - angle.mean())) < 1.5e-4
    assert np.polyfit(angle, found, 1)[0] == pytest.approx(1.0, abs=0.02)  # three standard deviations
    assert np.corrcoef(found, angle)[0, 1] > 0.999
    # The tracked point is some way off the centre of the turn, which moves it in proportion; beyond that, noise.
    rest = result.x_px - np.polyval(np.polyfit(angle, result.x_px, 1), angle)
    assert np.std(rest) < 0.004


@pytest.mark.few(1)
@pytest.mark.parametrize("degrees", [0.0, 0.3])
def test_the_stated_deviation_of_a_small_angle_is_its_error(degrees: float) -> None:
    angle = np.radians(degrees) * np.sin(np.arange(100) / 4)
    result = track(turning_film(angle), [30, 10, 60, 44])
    error = (result.angle - angle)[1:]  # against the angle of the first frame, which every other is relative to
    assert np.std(error / result.sigma_angle[1:]) == pytest.approx(1.0, abs=0.21)  # three of 1 / sqrt(2 n)
    assert np.nanmedian(result.sigma_angle) < 1.5e-4


# ---- what cannot be tracked


def nothing_moves(i):
    return expose(128 + speckle(SHAPE, np.random.default_rng(5)), np.random.default_rng([6, i]))


def plain_noise(i):
    return expose(np.full(SHAPE, 128.0), np.random.default_rng([6, i]))


def all_black(i):
    return np.zeros(SHAPE, np.uint8)


@pytest.mark.parametrize(
    ("draw", "target", "said"),
    [
        (
            plain_noise,
            None,
            r"film.test: expected a moving target but nothing in the film moves or has enough texture .*",
        ),
        (all_black, None, "film.test: the film has no contrast, its frames are all one grey; check lighting"),
        (all_black, [10, 10, 20, 20], r"the target \[10, 10, 20, 20\] has no contrast in frame 0"),
        (nothing_moves, [230, 10, 20, 20], r"a target inside the 240x64 px picture but got \[230, 10, 20, 20\]"),
        (nothing_moves, [10, 10, 4, 20], "expected a target of at least 8x8 px but got 4x20 px"),
        (nothing_moves, [10, 10, 20], r"expected a target \[x, y, w, h\] in px but got \[10"),
    ],
)
def test_what_cannot_be_tracked_is_said(draw, target, said):
    with pytest.raises(FrictrackError, match=said):
        track(Film(draw, 20, SHAPE), target)


# ---- losing the target


def test_leaving_the_frame_is_nan_with_the_reason():
    x = 60 + 2.6 * np.arange(N)
    result = track(a_film(x))
    out = x + SIZE[1] / 2 > SHAPE[1] + 6
    assert not result.found[out].any()
    assert set(result.reason[out]) == {"target leaves the frame"}
    assert result.found[x + SIZE[1] / 2 < SHAPE[1] - 1].all()
    assert np.nanmax(np.abs(error(result, x))) < 0.02


def test_what_looks_alike_and_stands_is_not_taken_for_a_target_that_has_left():
    x, tall = 60 + 2.6 * np.arange(N), (128, 240)
    source = block_film(x, np.full(N, 30.0), size=SIZE, shape=tall)
    double = source.frame(0)[14:46, 38:82] + speckle((32, 44), np.random.default_rng(5), contrast=20.0)

    def draw(i):
        frame = source.frame(i).copy()
        frame[84:116, 100:144] = np.clip(double, 0, 255)
        return frame

    result = track(Film(draw, N, tall), [38, 14, 44, 32])
    out = x + SIZE[1] / 2 > tall[1] + 6
    assert not result.found[out].any()
    assert result.found[x + SIZE[1] / 2 < tall[1] - 1].all()
    assert np.nanmax(np.abs(result.y_px - result.y_px[0])) < 0.05


def test_corrupt_frames_are_nan_and_the_target_is_found_again():
    def spoil(i, frame):
        if i in (20, 21):
            frame[:] = 0
        if i == 40:
            frame[:] = np.random.default_rng(i).integers(0, 255, frame.shape)
        return frame

    result = track(a_film(SLIDE, spoil))
    assert np.flatnonzero(~result.found).tolist() == [20, 21, 40]
    assert result.reason[20] == "picture without contrast"
    assert result.reason[40].startswith("match score 0.")
    assert "below" in result.reason[40]
    for column in (result.x_px, result.y_px, result.sigma_px, result.angle):
        assert np.isnan(column[[20, 21, 40]]).all()
    assert np.nanstd(error(result, SLIDE)) < 0.004


def test_what_covers_the_target_is_not_tracked():
    def rod(i, frame):
        frame[:, 130:170] = 40
        return frame

    result = track(a_film(SLIDE, rod), rectangle(SLIDE[0]))
    hidden = np.abs(SLIDE - 150) < 6
    assert not result.found[hidden].any()
    # What looks out on one side is measured; nowhere is the target said to be where it is not.
    assert np.nanmax(np.abs(error(result, SLIDE))) < 0.06
    clear = np.abs(SLIDE - 150) > 48
    assert result.found[clear].all()
    assert np.nanstd(result.x_px[clear] - SLIDE[clear]) < 0.005


def test_a_jump_of_sixty_pixels():
    x = np.where(np.arange(N) < N // 2, 60.0, 120.0) + 0.3 * np.arange(N)
    result = track(a_film(x))
    assert result.found.all()
    assert np.std(error(result, x)) < 0.005


def test_frames_that_cannot_be_read():
    source = a_film(SLIDE)

    class Short(Film):
        def _read(self, indices):
            return super()._read(i for i in indices if i < 60)

    short = Short(source.frame, N, SHAPE, notes=("truncated film: 60 of 80 promised frames are in the file",))
    result = track(short, rectangle(SLIDE[0]))
    assert result.found[:60].all()
    assert set(result.reason[60:]) == {"frame cannot be read"}
    assert result.notes[0].startswith("truncated film")
    assert result.notes[1].startswith("60 of 80 frames could be read")


# ---- a still reference, repeatability, progress


def test_a_fixed_mark_stays_where_it_is():
    """The background itself may be tracked, as a reference for camera shake."""
    result = track(a_film(SLIDE), [2, 2, 100, 10], name="base")
    assert result.name == "base"
    assert result.found.all()
    assert np.std(result.x_px) < 1.2 * np.median(result.sigma_px)
    assert np.median(result.sigma_px) < 0.006


def test_the_line_to_paste_repeats_the_track():
    x = np.concatenate([np.full(10, -60.0), 40 + 2.0 * np.arange(60)])  # enters later
    recording = a_film(x)
    first = track(recording)
    assert np.flatnonzero(first.found)[0] == 10
    lines = dict(line.split(" = ") for line in target_line(first).splitlines())
    numbers = [int(v) for v in lines["target"].strip("[]").split(",")]
    again = track(recording, numbers, template=int(lines["template"]))
    np.testing.assert_array_equal(first.found, again.found)
    np.testing.assert_allclose(first.x_px, again.x_px, atol=1e-3)


def test_progress_counts_up():
    seen = []
    track(a_film(SLIDE), progress=lambda done, total, what: seen.append((done, total, what)))
    assert {what for _, _, what in seen} == {"find the target", "follow", "measure"}
    assert all(0 <= done <= total for done, total, _ in seen)


def test_a_false_find_is_given_up_when_the_target_appears():
    """While the block is hidden something like it matches; that must not be followed once the block is back."""
    source = a_film(60 + 1.5 * np.arange(N), noise=False)
    decoy = source.frame(60)[20:44, 140:170].astype(float)

    def draw(i):
        frame = source.frame(i).copy()
        if i < 30:
            frame[8:56, :150] = 90
        spoilt = 0.5 * decoy + 0.5 * (128 + speckle(decoy.shape, np.random.default_rng(11)))
        frame[36:60, 4:34] = spoilt
        return frame

    recording = Film(draw, N, SHAPE)
    result = track(recording, [140, 20, 30, 24], template=60)
    assert result.found[30:].all()
    assert np.std((result.x_px - 1.5 * np.arange(N))[30:]) < 0.005


def test_a_target_that_never_returns():
    """Every frame is another speckle: nothing can be followed, and this is said."""
    frames = [expose(128 + speckle(SHAPE, np.random.default_rng([1, i])), None) for i in range(20)]
    with pytest.raises(
        FrictrackError, match=r"the target \[40, 10, 40, 40\] is found in fewer than two frames; choose"
    ):
        track(Film(lambda i: frames[i], 20, SHAPE), [40, 10, 40, 40])
