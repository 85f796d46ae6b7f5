"""Targets with an outline, parts that are no part of them, and obstacles that are drawn in the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cost import within
from film import Film, expose, moved, speckle
from matplotlib.path import Path as Outline

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.base.polygons import inside, polygon
from frictrack.records import Array, Track
from frictrack.study import load
from frictrack.tracking import Areas, contact_sheet, track

SHAPE, N = (90, 220), 50
TRIANGLE = [(0.0, 0.0), (70.0, 14.0), (20.0, 56.0)]  # the body, px from where it is in frame 0
AT = np.array([14.0, 16.0])
K = np.arange(N)
X, Y = 1.9 * K + 0.013 * K**2, 2.0 * np.sin(K / 9)


def drawn(bar: tuple[int, int] | None = None, hole: bool = False) -> Film:
    """Film of a speckled triangle before a speckled wall; a lamp flickers in its hole, a bar stands before it."""
    rng = np.random.default_rng(5)
    texture, wall = speckle(SHAPE, rng, contrast=30.0), 110 + speckle(SHAPE, rng, contrast=30.0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)

    def draw(i: int) -> np.ndarray:
        at = np.stack([x - AT[0] - X[i], y - AT[1] - Y[i]])
        mask = 1.0
        for (ax, ay), (bx, by) in zip(TRIANGLE, (*TRIANGLE[1:], TRIANGLE[0]), strict=True):
            far = ((bx - ax) * (at[1] - ay) - (by - ay) * (at[0] - ax)) / np.hypot(bx - ax, by - ay)
            mask = mask / (1 + np.exp(-4 * far))
        picture = (1 - mask) * wall + mask * (130 + moved(texture, X[i], Y[i]))
        if hole:
            blink = np.exp(-(((at[0] - 28) / 5) ** 2) - ((at[1] - 24) / 5) ** 2)
            picture = picture + 80 * np.sin(2.1 * i) * blink
        if bar is not None:
            picture[:, bar[0] : bar[1]] = 200.0
        return expose(picture, np.random.default_rng([8, i]))

    frames = [draw(i) for i in range(N)]
    return Film(lambda i: frames[i], N, SHAPE, fps=1000.0)


def corners(inset: float = 3.0) -> list[list[float]]:
    """The triangle in frame 0, somewhat smaller."""
    points = np.array(TRIANGLE)
    middle = points.mean(axis=0)
    far = np.hypot(*(points - middle).T)[:, None]
    return (AT + middle + (points - middle) * (1 - 2 * inset / far)).tolist()


def rated(result: Track) -> Array:
    """Errors along x and y over their stated deviations (2, n), without a constant."""
    off = np.stack([result.x_px - X, result.y_px - Y])
    off -= np.nanmedian(off, axis=1, keepdims=True)
    return off / np.stack([result.sigma_px, result.sigma_y_px])


def test_an_outline_keeps_what_is_behind_a_target_out_of_it() -> None:
    result = track(drawn(), corners())
    assert result.found.all()
    assert np.sqrt(np.mean(rated(result)[:, 1:] ** 2)) == pytest.approx(1.0, abs=0.25)
    assert len(result.outline) == 3
    x, y, w, h = result.target or (0, 0, 0, 0)
    assert AT[0] < x < x + w < AT[0] + 70
    assert AT[1] < y < y + h < AT[1] + 56


def test_what_is_excluded_counts_nothing() -> None:
    lamp = [[AT[0] + 28 + 13 * np.cos(a), AT[1] + 24 + 13 * np.sin(a)] for a in np.arange(8) * np.pi / 4]
    result = track(drawn(hole=True), Areas(corners(), exclude=[lamp]))
    assert result.found.all()
    assert np.sqrt(np.mean(rated(result)[:, 1:] ** 2)) == pytest.approx(1.0, abs=0.25)


def test_an_obstacle_that_is_drawn_moves_no_frame() -> None:
    film = drawn(bar=(80, 100))
    result = track(film, Areas(corners(), obstacles=[[79, 0, 22, 90]]))
    assert result.found.all()
    assert np.max(np.abs(rated(result)[:, 1:])) < 5
    assert np.sqrt(np.mean(rated(result)[:, 1:] ** 2)) == pytest.approx(1.0, abs=0.25)
    behind = (X + AT[0] + 35 > 75) & (X + AT[0] + 10 < 105)
    assert np.median(result.sigma_px[behind]) > 1.1 * np.median(result.sigma_px[~behind])


def test_what_was_drawn_is_shown(tmp_path: Path) -> None:
    film = drawn(bar=(80, 100))
    areas = Areas(corners(), exclude=[[30, 35, 8, 8]], obstacles=[[79, 0, 22, 90]])
    result = track(film, areas)
    sheet = contact_sheet(film, result, tmp_path / "sheet.png")
    plain = contact_sheet(film, ft.records.Track(**{**vars(result), "obstacles": ()}), tmp_path / "plain.png")
    assert sheet.read_bytes() != plain.read_bytes()


# ---- what is no polygon


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        ([[0, 0], [9, 9]], "expected a polygon of 3 to 1000 corners but got 2"),
        ([[0, 0], [40, 40], [40, 0], [0, 40]], "whose sides do not cross but side 1 meets side 3; give its corners in"),
        ([[0, 0], [40, 0], [80, 0]], "whose sides do not cross but side 1 meets side 3"),
        ([[0, 0], [40, "a"], [80, 0]], r"expected a polygon \[\[x, y\], \[x, y\], \[x, y\], ...\] in px but got"),
        ([10, 10, 0, 5], r"expected a rectangle \[x, y, width, height\] with a size but got \[10, 10, 0, 5\]"),
    ],
)
def test_what_is_no_polygon_is_said(raw: object, said: str) -> None:
    with pytest.raises(FrictrackError, match=said):
        polygon(raw)
    with pytest.raises(FrictrackError, match=said):
        Areas([10, 10, 30, 30], obstacles=[raw])


@pytest.mark.parametrize(
    ("areas", "said"),
    [
        (Areas([[10, 10], [230, 10], [20, 60]]), r"expected a target inside the 220x90 px picture but got a corner at"),
        (
            Areas([10, 10, 40, 40], exclude=[[30, 30, 8, 80]]),
            "expected an area to exclude inside the 220x90 px picture",
        ),
        (Areas([10, 10, 40, 40], obstacles=[[30, -9, 8, 80]]), "expected an obstacle inside the 220x90 px picture but"),
        (Areas([10, 10, 40, 40], exclude=[[8, 8, 50, 50]]), "outline and exclusions leave 0; draw the target larger"),
    ],
)
def test_what_does_not_fit_the_picture_is_said_at_once(areas: Areas, said: str) -> None:
    film = drawn()
    with within(50), pytest.raises(FrictrackError, match=said):
        track(film, areas)


def test_pixels_inside_are_those_of_another_library() -> None:
    rng = np.random.default_rng(2)
    turn = np.sort(rng.uniform(0, 2 * np.pi, 11))
    star = polygon((30 + 25 * rng.uniform(0.3, 1, (11, 1)) * np.column_stack([np.cos(turn), np.sin(turn)])).tolist())
    y, x = np.mgrid[5:60, 3:61]
    expected = Outline(star).contains_points(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    assert np.array_equal(inside(star, x.shape, (3, 5)), expected)


# ---- the study file

STUDY = """
[study]
mass = "0.35 kg"
[camera]
fps = 1000
scale = "0.5 mm/px"
[[run]]
video = "film.avi"
{}
"""


def test_a_study_file_names_the_areas(tmp_path: Path) -> None:
    (tmp_path / "film.avi").write_bytes(b"")
    lines = (
        "target = [[10, 10], [60, 12], [30, 50]]\nexclude = [[20, 20, 5, 5]]\nobstacles = [[[1, 1], [5, 1], [5, 9]]]"
    )
    (tmp_path / "study.toml").write_text(STUDY.format(lines))
    (run,) = load(tmp_path / "study.toml").runs
    assert run.target == ((10.0, 10.0), (60.0, 12.0), (30.0, 50.0))
    assert run.exclude == (((19.5, 19.5), (24.5, 19.5), (24.5, 24.5), (19.5, 24.5)),)
    assert run.obstacles == (((1.0, 1.0), (5.0, 1.0), (5.0, 9.0)),)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("target = [[1, 1], [2, 2]]", "target: expected a polygon of 3 to 1000 corners but got 2"),
        ("target = [[0, 0], [40, 40], [40, 0], [0, 40]]", "target: expected a polygon whose sides do not cross"),
        ("obstacles = [[1, 1], [5, 1], [5, 9]]", r"obstacles: expected a polygon \[\[x, y\], .* but got \[1, 1\]"),
        ("exclude = [[20, 20, 5, 5]]", "expected a target with exclude"),
    ],
)
def test_a_study_file_with_a_bad_polygon_is_refused(tmp_path: Path, lines: str, said: str) -> None:
    (tmp_path / "film.avi").write_bytes(b"")
    (tmp_path / "study.toml").write_text(STUDY.format(lines))
    with pytest.raises(FrictrackError, match=said):
        load(tmp_path / "study.toml")
