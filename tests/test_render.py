"""The renderer against slow direct sums, closed forms, Fourier phases and photon statistics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tifffile

from frictrack.base.errors import FrictrackError
from frictrack.simulate.rendering import (
    Camera,
    Highlight,
    Oscillation,
    Rod,
    Surface,
    Target,
    render,
    render_clean,
    write_film,
)
from frictrack.simulate.rendering.renderer import FourierSurface, MovingCells

SNAP = Camera(width=64, height=48, exposure=0.0)
SMALL = Target(24, 18, Surface(size=3.0), course=False)
UNIFORM = Surface(level=0.5, contrast=0.0)


def sliding(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of a block that moves by one pixel per frame at 4000 fps."""
    return 25.0 + 4000.0 * t, np.full_like(t, 20.0)


def still(x: float, y: float, angle: float | None = None, camera: Camera = SNAP, target: Target = SMALL) -> np.ndarray:
    """One noise-free frame of a block at rest."""
    place = (x, y) if angle is None else (x, y, angle)
    (frame,) = render_clean(lambda t: tuple(np.full_like(t, p) for p in place), camera, target, 1)
    return frame


def value(series: FourierSurface, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The series term by term, at points of any shape."""
    total = np.zeros(u.shape)
    for j, q_y in enumerate(series.q_y):
        for k, q_x in enumerate(series.q_x):
            if abs(series.c[j, k]) > 1e-9:
                total += (series.c[j, k] * np.exp(1j * (q_x * u + q_y * v))).real
    return total


def backdrop(target: Target = SMALL, camera: Camera = SNAP) -> np.ndarray:
    """The picture with the block far away."""
    return still(-500.0, 20.0, camera=camera, target=target)


def phase_shift(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Shift from a to b of periodic pictures by a weighted fit of their Fourier phases."""
    fa, fb = np.fft.rfft2(a), np.fft.rfft2(b)
    q_y = 2 * np.pi * np.fft.fftfreq(a.shape[0])[:, None] + 0 * fa.real
    q_x = 2 * np.pi * np.fft.rfftfreq(a.shape[1]) + 0 * fa.real
    weight = np.abs(fa) * (np.abs(fa) > 1e-6 * np.abs(fa[0, 0]))
    weight[:, -1] = weight[a.shape[0] // 2] = 0  # Nyquist has no phase
    design = np.stack([(-q_x * weight).ravel(), (-q_y * weight).ravel()], axis=1)
    phase = np.angle(fb * np.conj(fa)) * weight
    return tuple(np.linalg.lstsq(design, phase.ravel(), rcond=None)[0])


# ---- exactness of the picture


@pytest.mark.parametrize("kind", ["speckle", "dots", "checker"])
def test_every_kind_of_pixel_is_the_integral_over_its_covered_part(kind: str) -> None:
    target = Target(24, 18, Surface(kind, 3.0), course=False)
    x, y = 30.2371, 22.6180
    frame, behind = still(x, y, target=target), backdrop(target)
    series = target.surface.series(24, 18)
    z, w = np.polynomial.legendre.leggauss(12)
    for row, column in [(22, 30), (22, 18), (22, 42), (14, 30), (31, 30), (14, 18), (31, 42), (5, 5)]:
        x0, x1 = max(column - 0.5, x - 12), min(column + 0.5, x + 12)
        y0, y1 = max(row - 0.5, y - 9), min(row + 0.5, y + 9)
        dx, dy = max(x1 - x0, 0), max(y1 - y0, 0)
        u, v = np.meshgrid((x0 + x1) / 2 + dx / 2 * z - x, (y0 + y1) / 2 + dy / 2 * z - y)
        light = np.sum(np.outer(w, w) * value(series, u, v)) * dx * dy / 4
        assert frame[row, column] == pytest.approx(light + (1 - dx * dy) * behind[row, column], abs=1e-10)


def supersampled(x: float, y: float, angle: float, n: int) -> np.ndarray:
    """The whole scene point by point, n x n points a pixel, mask and all."""
    series = SMALL.surface.series(24, 18)
    fine = (np.arange(48 * n) + 0.5) / n - 0.5
    dx, dy = np.meshgrid((np.arange(64 * n) + 0.5) / n - 0.5 - x, fine - y)
    u, v = np.cos(angle) * dx + np.sin(angle) * dy, np.cos(angle) * dy - np.sin(angle) * dx
    inside = (np.abs(u) < 12) & (np.abs(v) < 9)
    picture = np.kron(backdrop(), np.ones((n, n)))
    picture[inside] = value(series, u[inside], v[inside])
    return picture.reshape(48, n, 64, n).mean(axis=(1, 3))


@pytest.mark.slow
def test_whole_frame_agrees_with_supersampling() -> None:
    # At a multiple of 1/16 px the sampled mask is exact and only the midpoint rule's 1e-4 is left.
    assert np.abs(still(30.0625, 22.1875) - supersampled(30.0625, 22.1875, 0.0, 16)).max() < 2e-4


@pytest.mark.slow
def test_turned_block_agrees_with_supersampling() -> None:
    frame, slow = still(30.2, 22.6, 0.07), supersampled(30.2, 22.6, 0.07, 16)
    assert np.abs(frame - slow)[16:29, 21:40].max() < 2e-4  # inside the block
    assert np.abs(frame - slow).max() < 0.01  # cut pixels: the sampled mask's own 1/16


def test_block_turned_by_nothing_is_the_straight_block() -> None:
    straight, turned = still(30.237, 22.618), still(30.237, 22.618, 0.0)
    assert np.abs(turned - straight)[16:29, 21:40].max() < 1e-6
    assert np.abs(turned - straight).max() < 6e-3  # cut pixels to first order


def test_shift_of_periodic_frames_is_exact() -> None:
    series = Surface().series(48, 32)  # closes on itself after 64 x 48 px
    rng = np.random.default_rng(3)

    def picture(x: float, y: float) -> np.ndarray:
        borders = np.arange(65) - 0.5, np.arange(49) - 0.5
        whole = zip(borders, series.waves(*borders), (x, y), strict=True)
        columns, rows = (MovingCells(edges, waves, np.array([at]), 1000.0) for edges, waves, at in whole)
        return series.integrate_cells(columns, rows, np.ones(1))

    for x, y in rng.uniform(-0.5, 0.5, (20, 2)):
        found = phase_shift(picture(0, 0), picture(x, y))
        assert found == pytest.approx((x, y), abs=1e-8)


def test_shift_of_rendered_frames_is_exact() -> None:
    wide = Target(400, 300, Surface("checker", 4.0))  # covers the picture; period 8 px divides 64 and 48
    for x in (0.1, 0.25, 0.5, 0.73):
        found = phase_shift(still(30, 20, target=wide), still(30 + x, 20 - x / 3, target=wide))
        assert found == pytest.approx((x, -x / 3), abs=1e-8)


def test_a_whole_pixel_moves_the_block_and_nothing_else() -> None:
    a, b = still(30.3, 20.4), still(37.3, 20.4)
    assert np.abs(a[12:29, 19:42] - b[12:29, 26:49]).max() < 1e-12
    assert np.array_equal(b[:, :20], backdrop()[:, :20])


@pytest.mark.parametrize("x", [-5.0, 3.2, 62.9, 200.0])
def test_block_may_leave_the_picture(x: float) -> None:
    assert np.all(np.isfinite(still(x, 20.0)))
    assert np.all(np.isfinite(still(x, 20.0, 0.1)))


# ---- exposure


def moving(speed: float, exposure: float, target: Target, y_speed: float = 0.0) -> np.ndarray:
    """One frame of a block at 30.1, 22.3 px that moves at speed px per frame."""
    camera = Camera(width=64, height=48, fps=1.0, exposure=exposure)
    (frame,) = render_clean(lambda t: (30.1 + speed * t, 22.3 + y_speed * t), camera, target, 1)
    return frame


@pytest.mark.parametrize(("speed", "exposure"), [(0.9, 0.1), (2.0, 0.5), (-7.3, 1.0)])
def test_motion_blur_of_the_texture_is_a_sinc(speed: float, exposure: float) -> None:
    wide = Target(400, 300, Surface("checker", 4.0))
    sharp, blurred = np.fft.rfft2(moving(0.0, 0.0, wide)), np.fft.rfft2(moving(speed, exposure, wide))
    expected = sharp * np.sinc(np.fft.rfftfreq(64) * speed * exposure)
    assert np.abs(blurred - expected).max() / np.abs(sharp).max() < 2e-8


@pytest.mark.parametrize("speed", [0.3, 2.0, -4.7])
def test_motion_blur_of_the_edges_is_a_difference_of_parabolas(speed: float) -> None:
    target = Target(24, 18, Surface(level=1.0, contrast=0.0), Surface(level=0.0, contrast=0.0), course=False)
    row = moving(speed, 0.8, target)[22]

    def parabola(z: np.ndarray) -> np.ndarray:
        return np.maximum(z, 0) ** 2 / 2

    def edge(place: float) -> np.ndarray:
        """Pixel box convolved with motion box convolved with a step at `place`."""
        z, b = np.arange(64) - place, 0.8 * abs(speed)
        return (
            parabola(z + (1 + b) / 2)
            - parabola(z + (1 - b) / 2)
            - parabola(z - (1 - b) / 2)
            + parabola(z - (1 + b) / 2)
        ) / b

    assert np.abs(row - (edge(30.1 - 12) - edge(30.1 + 12))).max() < 1e-9


def test_exposure_is_the_mean_of_many_instants() -> None:
    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 30.1 + 2.5 * t - 0.8 * t**2, 22.3 + 0.4 * np.sin(2 * t)

    camera = Camera(width=64, height=48, fps=1.0, exposure=0.9)
    (frame,) = render_clean(path, camera, SMALL, 1)
    n = 1500
    snaps = render_clean(lambda t: path(0.9 * (t * SNAP.fps + 0.5) / n - 0.45), SNAP, SMALL, n)
    mean = np.mean(list(snaps), axis=0)
    assert np.abs(frame - mean).max() < 3e-5  # 1/n at a cut pixel


# ---- nuisances


def test_shake_moves_the_whole_picture() -> None:
    shaken = Camera(width=64, height=48, exposure=0.1, shake_x=Oscillation(3.0, 0.0, np.pi / 2))
    a, b = still(30.3, 20.4), still(30.3, 20.4, camera=shaken)
    assert np.abs(b[:, 3:] - a[:, :-3]).max() < 1e-12


def test_flicker_is_averaged_over_the_exposure() -> None:
    camera = Camera(width=64, height=48, fps=100.0, exposure=0.8, flicker=Oscillation(0.2, 60.0, 0.4))
    frames = render_clean(lambda t: (30 + 0 * t, 20 + 0 * t), camera, SMALL, 5)
    dark = still(30.0, 20.0)
    omega = 2 * np.pi * 60
    for i, frame in enumerate(frames):
        a, b = omega * (i / 100 - 0.004) + 0.4, omega * (i / 100 + 0.004) + 0.4
        light = 1 + 0.2 * (np.cos(a) - np.cos(b)) / (b - a)
        assert np.abs(frame / dark - light).max() < 1e-4


def test_rotation_turns_the_block_about_its_centre() -> None:
    spun = Target(24, 18, SMALL.surface, course=False, rotation=Oscillation(0.07, 0.0, np.pi / 2))
    assert np.array_equal(still(30.2, 22.6, target=spun), still(30.2, 22.6, 0.07))


def test_a_rod_hides_what_is_behind_it_to_the_part_of_a_pixel() -> None:
    bare = still(30.3, 20.4)
    seen = still(30.3, 20.4, target=replace(SMALL, rod=Rod(29.8, 5.0, 0.06)))  # from 27.3 to 32.3 px
    cover = np.zeros(64)
    cover[27:33] = [0.2, 1, 1, 1, 1, 0.8]
    assert np.abs(seen - (bare * (1 - cover) + 0.06 * cover)).max() < 1e-12


def test_a_rod_shakes_with_the_scene_and_dims_with_the_light() -> None:
    rod = replace(SMALL, rod=Rod(29.8, 5.0, 0.06))
    lit = {"flicker": Oscillation(0.2, 0.0, np.pi / 2), "shake_x": Oscillation(3.0, 0.0, np.pi / 2)}
    a = still(30.3, 20.4, target=rod)
    b = still(30.3, 20.4, target=rod, camera=Camera(width=64, height=48, exposure=0.1, **lit))
    assert np.abs(b[:, 3:] - 1.2 * a[:, :-3]).max() < 1e-12


def test_a_highlight_stays_in_the_picture_and_adds_its_light() -> None:
    spot = Highlight(40.3, 11.2, 2.0, 0.25)
    shaken = Camera(width=64, height=48, exposure=0.1, shake_x=Oscillation(3.0, 0.0, np.pi / 2))
    added = still(30.3, 20.4, target=replace(SMALL, highlight=spot), camera=shaken) - still(30.3, 20.4, camera=shaken)
    fine = (np.arange(64 * 40) + 0.5) / 40 - 0.5
    light = 0.25 * np.exp(-((fine - 40.3) ** 2 + (fine[: 48 * 40, None] - 11.2) ** 2) / 8)
    assert np.abs(added - light.reshape(48, 40, 64, 40).mean(axis=(1, 3))).max() < 1e-5


def test_drift_changes_the_light_linearly() -> None:
    camera = Camera(fps=100.0, drift=-5.0, flicker=Oscillation(0.1, 0.0, np.pi / 2))
    assert camera.light(np.array([0.0, 0.1, 0.15, 0.3])) == pytest.approx([1.1, 0.55, 0.275, 0.0])


def test_flat_field_noise_is_a_fixed_pattern_in_proportion_to_the_light() -> None:
    camera = Camera(width=200, height=150, full_well=1e6, read_noise=0.0, bit_depth=16, black=0.0, prnu=0.01)
    rng = np.random.default_rng(0)
    light = np.repeat([0.2, 0.8], 100) * np.ones((150, 1))
    frames = np.stack([camera.record(light, rng) / camera.mean(light) for _ in range(8)])
    pattern = frames.mean(axis=0) - 1
    shot = 1 / np.sqrt(8 * camera.electrons(np.array([0.2, 0.8])))
    for half, alone in ((pattern[:, :100], shot[0]), (pattern[:, 100:], shot[1])):
        assert half.std() == pytest.approx(np.hypot(0.01, alone), rel=0.025)  # 15 000 values: 0.6 %
    assert np.abs(pattern - (camera.sensitivity - 1)).max() < 6 * shot[0]
    assert not np.array_equal(camera.sensitivity, replace(camera, prnu_seed=1).sensitivity)


# ---- camera


@pytest.mark.parametrize(("full_well", "level"), [(15_000.0, 0.6), (1_000.0, 0.3)])
def test_noise_follows_the_photon_transfer_curve(full_well: float, level: float) -> None:
    camera = Camera(full_well=full_well, read_noise=20.0, bit_depth=12, black=64)
    frame = camera.record(np.full((500, 500), level), np.random.default_rng(0)).astype(float)
    electrons = level * 0.8 * full_well
    gain = (4095 - 64) / full_well
    assert frame.mean() == pytest.approx(64 + gain * electrons, rel=2e-4)
    # The standard deviation of a variance of n values is sqrt(2/n): 0.28 %.
    assert frame.var() == pytest.approx(gain**2 * (electrons + 20.0**2) + 1 / 12, rel=0.012)
    assert camera.noise(np.full((1, 1), level))[0, 0] ** 2 == pytest.approx(frame.var(), rel=0.012)


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_white_is_four_fifths_of_full_scale_and_nothing_overflows(bits: int, dtype: type) -> None:
    camera = Camera(bit_depth=bits, full_well=1e6, black=0.0)
    rng = np.random.default_rng(0)
    white = camera.record(np.ones((50, 50)), rng)
    assert white.dtype == dtype
    assert white.mean() == pytest.approx(0.8 * (2**bits - 1), rel=1e-3)
    assert camera.record(np.full((9, 9), 3.0), rng).min() == 2**bits - 1
    assert camera.record(np.full((9, 9), -1.0), rng).max() < 0.001 * 2**bits


def test_same_seed_same_film() -> None:
    def film(seed: int) -> np.ndarray:
        return np.stack(list(render(sliding, SNAP, SMALL, np.random.default_rng(seed), 6)))

    assert np.array_equal(film(1), film(1))
    assert not np.array_equal(film(1), film(2))


# ---- films


@pytest.fixture
def frames() -> list[np.ndarray]:
    return list(render(sliding, Camera(width=64, height=48), SMALL, np.random.default_rng(0), 12))


def opencv_frames(path: str) -> Iterator[np.ndarray]:
    capture = cv2.VideoCapture(path)
    while (answer := capture.read())[0]:
        yield answer[1][..., 0]


@pytest.mark.parametrize(("name", "most"), [("a.avi", 2.0), ("a.mov", 0.0)])
@pytest.mark.parametrize("fps", [30.0, 4000.0, 100_000.0])
def test_video_holds_every_frame_and_the_frame_rate(tmp_path, frames, name: str, most: float, fps: float) -> None:
    path = str(tmp_path / name)
    assert write_film(iter(frames), path, fps) == 12
    assert cv2.VideoCapture(path).get(cv2.CAP_PROP_FPS) == pytest.approx(fps)
    back = list(opencv_frames(path))
    assert len(back) == 12
    assert np.mean(np.abs(np.subtract(back, frames, dtype=float))) <= most


def test_better_quality_is_closer(tmp_path, frames) -> None:
    for quality in (50, 100):
        write_film(frames, tmp_path / f"{quality}.avi", 4000.0, quality)
    poor, good = (
        np.mean(np.abs(np.subtract(list(opencv_frames(str(tmp_path / f"{q}.avi"))), frames, dtype=float)))
        for q in (50, 100)
    )
    assert good < 0.9 * poor


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_tiff_and_png_keep_every_bit(tmp_path, bits: int) -> None:
    camera = Camera(width=64, height=48, bit_depth=bits)
    film = list(render(sliding, camera, SMALL, np.random.default_rng(0), 5))
    write_film(film, tmp_path / "a.tif", 4000.0)
    write_film(film, tmp_path / "folder", 4000.0)
    with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
        assert np.array_equal(tiff.asarray(), film)
        assert tiff.imagej_metadata["finterval"] == pytest.approx(1 / 4000)
    pages = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted((tmp_path / "folder").iterdir())]
    assert np.array_equal(pages, film)


def test_a_film_that_fails_leaves_the_old_one(tmp_path, frames) -> None:
    path = tmp_path / "a.avi"
    write_film(frames, path, 4000.0)
    before = path.read_bytes()

    def broken() -> Iterator[np.ndarray]:
        yield frames[0]
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        write_film(broken(), path, 4000.0)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# ---- bad input


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: Camera(exposure=2.5e-5 * 1e6), "exposure between 0 and 1 frame interval but got 25"),
        (lambda: Camera(bit_depth=10), "bit depth of 8, 12 or 16 but got 10"),
        (lambda: Camera(fps=0), "expected fps above 0 but got 0"),
        (lambda: Surface("stripes"), 'expected kind speckle, dots, checker but got "stripes"'),
        (lambda: Surface(level=0.2, contrast=0.3), "contrast between 0 and the level 0.2 but got 0.3"),
        (lambda: Camera(prnu=1.0), "flat-field noise between 0 and 0.2 but got 1; 0.01 is 1 %"),
        (lambda: Rod(9.0, 0.0), "rod: expected a width above 0 px but got 0 px"),
        (lambda: Highlight(9.0, 9.0, -1.0), "highlight: expected a radius above 0 px but got -1 px"),
        (lambda: Target(0.5, 20), "larger than 1 x 1 px but got 0.5 x 20"),
        (lambda: write_film([], "a.avi", 30), "at least one frame to write but got none"),
        (lambda: write_film([np.zeros((4, 4, 3), np.uint8)], "a.avi", 30), r"grey frames of 8 or 16 bit but got"),
        (lambda: write_film([np.zeros((4, 4), np.uint16)], "a.avi", 30), "8-bit frames for .avi but got uint16"),
        (lambda: write_film([np.zeros((4, 4), np.uint8)], "a.gif", 30), 'ending in .avi, .mov, .tif.*but got ".gif"'),
    ],
)
def test_bad_input_is_named(call, text: str) -> None:
    with pytest.raises(FrictrackError, match=text):
        call()
