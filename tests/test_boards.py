"""Boards, lenses and points of known place against a pinhole camera that knows nothing of the code under test."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from pinhole import CENTRE, FOCAL, LENS, NO_LENS, SIZE, charuco, checkers, homography, pictured, shot, through, turned
from repeats import few_or_many

from frictrack.base.errors import FrictrackError
from frictrack.measure.calibration import parse_scale, plane_map
from frictrack.measure.calibration.lens import plane_from_views
from frictrack.measure.calibration.pictures import Board, BoardView

TILTED = turned(0.1, 0.35, 0.05), np.array([-0.05, -0.03, 0.6])  # keystone of a fifth
FLAT = turned(0.02, 0.15, 0.02), np.array([-0.07, -0.04, 0.55])
CORNERS = np.array([[0, 0], [0.14, 0], [0.14, 0.08], [0, 0.08], [0.07, 0.03]])
GRID = 0.02 * np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2).astype(float)
PATH = np.column_stack([np.linspace(0.0, 0.15, 30), np.full(30, 0.05)])
BOARD = Board((9, 6), 0.02)
SMALL = (640, 480)
DRAWN: dict = {}  # pictures take longer to draw than to look at
VIEW = turned(0.1, 0.3, 0.05), np.array([-0.045, -0.03, 0.3])


def spread(z: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(z))))


def z_of(made, ends, length=0.15) -> float:
    found, relative = made.length(ends)
    return (found - length) / (relative * found)


# ---- points of known place


@pytest.mark.parametrize("n", [4, 5])
def test_points_of_a_tilted_plane(n):
    """Exact points give exact places anywhere; clicked ones lengths as uncertain as stated."""
    seen, path = shot(CORNERS[:n], *TILTED), shot(PATH, *TILTED)
    exact = plane_map({"points": seen.tolist(), "plane": CORNERS[:n].tolist()})
    np.testing.assert_allclose(exact(path), PATH, atol=1e-9)
    rng = np.random.default_rng(1)
    z = []
    for _ in range(160):
        clicked = (seen + rng.normal(0, 0.5, seen.shape)).tolist()
        z.append(z_of(plane_map({"points": clicked, "plane": CORNERS[:n].tolist()}), path[[0, -1]]))
    assert 0.9 < spread(z) < 1.1
    assert abs(np.mean(z)) < 0.2


def test_a_single_scale_on_that_plane_is_off_by_percents():
    """What the homography is for: the scale of a ruler at one end does not hold at the other."""
    path = shot(PATH, *TILTED)
    ruler = plane_map({"points": path[:6:5].tolist(), "length": float(PATH[5, 0] - PATH[0, 0])})
    assert abs(ruler.length(path[[0, -1]])[0] / 0.15 - 1) > 0.02


def test_units_and_uncertain_places():
    seen, path = shot(CORNERS, *TILTED), shot(PATH, *TILTED)
    scale = {"points": seen.tolist(), "plane": (1e3 * CORNERS).tolist(), "unit": "mm", "click": "0.1 px"}
    sure = plane_map(scale)
    np.testing.assert_allclose(sure(path), PATH, atol=1e-9)
    texts = [[f"{1e3 * x} +/- 0.2 mm", f"{1e3 * y} +/- 0.2 mm"] for x, y in CORNERS]
    unsure = plane_map({"points": seen.tolist(), "plane": texts, "click": "0.1 px"})
    assert unsure.length(path[[0, -1]])[1] > 3 * sure.length(path[[0, -1]])[1]


def test_a_point_that_does_not_fit_is_told_and_enlarges_the_uncertainty():
    seen = shot(np.vstack([CORNERS, [[0.03, 0.06]]]), *TILTED)
    places = np.vstack([CORNERS, [[0.04, 0.06]]]).tolist()  # the last one is 10 mm wrong
    made = plane_map({"points": seen.tolist(), "plane": places})
    assert "times as far off as clicks of 0.5 px would" in made.notes[0]
    assert made.length(shot(PATH, *TILTED)[[0, -1]])[1] > 5e-3


LINE = [[0, 0], [1, 1], [2, 2], [3, 3.0]]
SQUARE = [[0, 0], [100, 0], [100, 100], [0, 100]]


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        ({"points": LINE, "plane": SQUARE}, "expected points that span a plane but all of them lie on one line"),
        ({"points": SQUARE, "plane": LINE}, "expected places on the plane that span a plane but all of them"),
        ({"points": [[0, 0], [50, 0], [100, 0], [0, 100]], "plane": [[0, 0], [5, 0], [9, 0], [0, 9]]}, "three of four"),
        ({"points": SQUARE, "plane": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "come in the same order"),
        ({"points": SQUARE[:3], "plane": SQUARE}, r"expected at least 4 points \[\[x, y\], ...\] but got 3"),
        ({"points": SQUARE, "plane": SQUARE[:3]}, "expected as many places as points but got 3 for 4 points"),
        ({"points": SQUARE, "plane": "here"}, r"expected plane as places \[\[X, Y\], ...\] but got 'here'"),
        ({"points": SQUARE, "plane": SQUARE, "unit": "kg"}, "the unit of plane"),
        ({"points": SQUARE, "plane": SQUARE, "click": "0 px"}, "above 0 px but got '0 px'"),
    ],
)  # fmt: skip
def test_points_that_determine_nothing(scale, said):
    with pytest.raises(FrictrackError, match=said):
        plane_map(scale)


# ---- boards: detected corners


def seen(pose, lens, rng, name="a"):
    return BoardView(name, 0, shot(GRID, *pose, lens) + rng.normal(0, 0.05, GRID.shape), GRID, SIZE)


@pytest.mark.parametrize(("repeats", "room"), few_or_many((24, 0.3), (80, 0.12)))
@pytest.mark.parametrize("lens", [NO_LENS, (-0.03, 0, 0, 0, 0), (-0.25, 0, 0, 0, 0)])
def test_one_view_gives_perspective_and_the_radial_distortion(lens, repeats, room):
    rng, path = np.random.default_rng(2), shot(PATH, *FLAT, lens)
    maps = [plane_from_views([seen(FLAT, lens, rng)], BOARD) for _ in range(repeats)]
    assert spread([z_of(m, path[[0, -1]]) for m in maps]) == pytest.approx(1.0, abs=room)
    assert np.median([np.abs(m(path) - PATH).max() for m in maps]) < 30e-6  # beyond the board, 0.05 px at 0.37 mm/px
    assert "radial distortion" in maps[0].used


def test_one_small_view_does_not_tell_the_lens_and_says_so():
    rng = np.random.default_rng(3)
    pose = FLAT[0], np.array([-0.07, -0.04, 3.0])
    made = plane_from_views([seen(pose, LENS, rng)], BOARD)
    assert "without lens distortion, which one picture does not determine" in made.used


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(1)
    tilts = [turned(*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.3, 0.3)) for _ in range(11)]
    shifts = np.array([-0.07, -0.04, 0.5]) + rng.uniform(-1, 1, (11, 3)) * [0.05, 0.03, 0.1]
    return [FLAT, *zip(tilts, shifts, strict=True)]


def test_several_views_give_camera_lens_and_plane(poses):
    rng, path = np.random.default_rng(4), shot(PATH, *FLAT, LENS)
    maps = [plane_from_views([seen(pose, LENS, rng) for pose in poses], BOARD) for _ in range(60)]
    assert 0.88 < spread([z_of(m, path[[0, -1]]) for m in maps]) < 1.15
    assert np.median([np.abs(m(path) - PATH).max() for m in maps]) < 25e-6
    np.testing.assert_allclose(maps[0].values[:4], [*FOCAL, *CENTRE], atol=6)
    assert "in 12 pictures, 480 corners, reprojected to 0.068 px" in maps[0].used
    assert "550 mm away: 1 mm between it and the target changes lengths by 0.18 %" in maps[0].used


def test_the_square_of_the_board_is_as_sure_as_stated():
    rng, path = np.random.default_rng(5), shot(PATH, *FLAT)
    made = plane_from_views([seen(FLAT, NO_LENS, rng)], Board((9, 6), 0.02, relative=0.01))
    assert made.length(path[[0, -1]])[1] == pytest.approx(0.01, rel=1e-3)


def test_jacobian_is_the_slope_of_the_map():
    made = plane_from_views([seen(FLAT, LENS, np.random.default_rng(6))], BOARD)
    at = shot(PATH, *FLAT, LENS)[10:11]
    for step in ([1e-3, 0.0], [0.0, 1e-3]):
        slope = made.jacobian(at)[0] @ step
        np.testing.assert_allclose((made(at + step) - made(at))[0], slope, rtol=1e-4, atol=1e-12)


# ---- boards: pictures


def drawn(folder: Path, board, name="board.png", view=VIEW) -> str:
    key = (board.tobytes(), *(part.tobytes() for part in view))
    if key not in DRAWN:
        DRAWN[key] = pictured(board, 40, homography(*view, 1200.0, SMALL), SMALL)
    cv2.imwrite(str(folder / name), DRAWN[key])
    return str(folder / name)


@pytest.mark.parametrize("squares", [(9, 6), (8, 6)])
@pytest.mark.parametrize("kind", ["checkerboard", "ChArUco", "ChArUco of old"])
def test_a_picture_of_a_board(tmp_path, squares, kind):
    scale = {"square": "10 mm", "squares": list(squares)}
    if kind == "checkerboard":
        scale["board"] = drawn(tmp_path, checkers(squares))
    else:
        scale["board"] = drawn(tmp_path, charuco(squares, legacy=kind == "ChArUco of old"))
        scale |= {"dictionary": "DICT_4X4_50", "marker": "7 mm"}
    made = plane_map(scale)
    ends = through(homography(*VIEW, 1200.0, SMALL), np.array([[0.0, 0.02], [0.08, 0.02]]))
    length, relative = made.length(ends)
    assert length == pytest.approx(0.08, rel=4 * relative)
    assert relative < 4e-4
    assert made.used.startswith(f"scale by a {'checkerboard' if kind == 'checkerboard' else 'ChArUco board'}, ")


def test_a_known_lens_and_one_picture_give_the_plane(tmp_path):
    lens = tmp_path / "lens.yml"
    file = cv2.FileStorage(str(lens), cv2.FILE_STORAGE_WRITE)
    file.write("camera_matrix", np.array([[1200, 0, 319.5], [0, 1200, 239.5], [0, 0, 1.0]]))
    file.write("distortion_coefficients", np.zeros((1, 5)))
    file.release()
    scale = {"board": drawn(tmp_path, checkers((9, 6))), "squares": [9, 6], "square": "10 mm"}
    made = plane_map(scale, lens=lens)
    ends = through(homography(*VIEW, 1200.0, SMALL), np.array([[0.0, 0.02], [0.08, 0.02]]))
    length, relative = made.length(ends)
    assert length == pytest.approx(0.08, rel=4 * relative)
    assert relative < plane_map(scale).length(ends)[1]  # it knows more
    assert made.used.endswith("seen through the lens of lens.yml")
    fields = {"K": [[1200, 0, 160], [0, 1200, 120], [0, 0, 1]], "D": [0, 0, 0, 0], "image_size": [320, 240]}
    lens.write_text(json.dumps(fields))
    with pytest.raises(FrictrackError, match=r"of 320x240 px, as the lens was calibrated on, but board\.png has 640"):
        plane_map(scale, lens=lens)


@pytest.mark.slow
def test_several_pictures_or_a_folder_of_them(tmp_path):
    """The first shows the plane of the course, or the one that is named."""
    names = [drawn(tmp_path, checkers((9, 6)), f"{i}.png", view) for i, view in enumerate(tilts())]
    scale = {"squares": [9, 6], "square": "10 mm"}
    of_list = plane_map(scale | {"board": names})
    of_folder = plane_map(scale | {"board": str(tmp_path)})
    third = plane_map(scale | {"board": names, "plane": 2})
    assert "in 5 pictures" in of_list.used
    assert "plane (2.png)" in third.used
    at = through(homography(turned(0.1, 0.3, 0.0), np.array([-0.045, -0.03, 0.3]), 1200.0, SMALL), CORNERS[:4] / 2)
    np.testing.assert_allclose(of_folder(at), of_list(at), atol=1e-6)
    assert of_list.length(at[:2])[0] == pytest.approx(0.07, rel=2e-3)
    assert of_list.values[0] == pytest.approx(1200, rel=0.02)


@pytest.mark.slow
def test_a_film_of_a_board_that_is_moved_about(tmp_path):
    """Views that differ are taken from it; the first that shows the board lies in the plane, or frame `plane`."""
    stack = np.stack([pictured(checkers((9, 6)), 40, homography(*view, 1200.0, SMALL), SMALL) for view in tilts()])
    blank = np.full((1, *SMALL[::-1]), 200, np.uint8)
    frames = np.concatenate([blank, stack])
    tifffile.imwrite(tmp_path / "moved.tif", frames, photometric="minisblack")
    scale = {"board": str(tmp_path / "moved.tif"), "squares": [9, 6], "square": "10 mm"}
    made = plane_map(scale)
    assert "in 5 pictures" in made.used
    assert "plane (moved.tif, frame 1)" in made.used
    assert made.values[0] == pytest.approx(1200, rel=0.02)
    assert "plane (moved.tif, frame 4)" in plane_map(scale | {"plane": 4}).used
    with pytest.raises(FrictrackError, match=r"expected plane as one of 6 frames of moved\.tif but got 6"):
        plane_map(scale | {"plane": 6})
    with pytest.raises(FrictrackError, match=r"9 x 6 squares in moved\.tif, frame 0 but found none"):
        plane_map(scale | {"plane": 0})


def tilts():
    angles = [(0.1, 0.3), (-0.3, 0.2), (0.3, -0.3), (0.0, -0.4), (0.35, 0.0)]
    return [(turned(x, y, 0.1 * i), np.array([-0.045, -0.03, 0.3])) for i, (x, y) in enumerate(angles)]


def test_pictures_that_do_not_tell_the_camera(tmp_path):
    """Two of them, or many that are not tilted: the homography of the first, and a word."""
    two = [drawn(tmp_path, checkers((9, 6)), f"{i}.png", view) for i, view in enumerate(tilts()[:2])]
    made = plane_map({"board": two, "squares": [9, 6], "square": "10 mm"})
    assert "in 0.png" in made.used
    assert made.notes[-1].startswith("the pictures do not determine the camera (at least three are needed")


def test_pictures_without_the_board(tmp_path):
    """Left out and named, but for the one that lies in the plane of the course."""
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full(SMALL[::-1], 200, np.uint8))
    scale = {"squares": [9, 6], "square": "10 mm"}
    board = drawn(tmp_path, checkers((9, 6)))
    notes = plane_map(scale | {"board": [board, str(blank)]}).notes
    assert notes == ("the board was not found in blank.png, which the scale goes without",)
    with pytest.raises(FrictrackError, match=r"9 x 6 squares in blank\.png but found none"):
        plane_map(scale | {"board": [str(blank), board]})


@pytest.mark.few(6)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"squares": [8, 5]}, r"it has 8 x 5 inner corners: write squares = \[9, 6\]"),
        ({"squares": [12, 7]}, "expected a checkerboard of 12 x 7 squares in board.png but found none; all of it must"),
        ({"squares": [9]}, r"along and across, 4 to 100 each, such as \[9, 6\], but got \[9\]"),
        ({"squares": [5, 3]}, r"along and across, 4 to 100 each, such as \[9, 6\], but got \[5, 3\]"),
        ({"squares": [5, 3.0]}, r"but got \[5, 3.0\]"),
        ({"square": "0 mm"}, "expected the side of a square above 0 m"),
        ({"square": "1 kg"}, "expected the side of a square as a quantity in m"),
        ({"marker": "7 mm"}, "expected both dictionary and marker for a ChArUco board"),
        ({"marker": "12 mm", "dictionary": "DICT_4X4_50"}, "expected a marker smaller than its square"),
        ({"marker": "7 mm", "dictionary": "DICT_9X9"}, 'expected a dictionary such as DICT_4X4_50 but got "DICT_9X9"'),
        ({"marker": "7 mm", "dictionary": "DICT_4X4_50"}, "expected a ChArUco board of 9 x 6 squares in board.png but"),
        ({"marker": "2 mm", "dictionary": "DICT_4X4_50", "squares": [20, 10]}, "of at least 100 markers for"),
        ({"plane": 3}, "expected plane as the number of one of 1 pictures but got 3"),
        ({"plane": "first"}, "expected plane as the number of a picture"),
        ({"board": "none.png"}, "expected a picture of the board none.png but there is no such file"),
        ({"board": 7}, "expected board as a picture, several, a folder or a recording but got 7"),
        ({"colour": "red"}, "expected a scale by board with the keys .* but got colour too"),
    ],
)  # fmt: skip
def test_boards_that_cannot_serve(tmp_path, change, said):
    scale = {"board": drawn(tmp_path, checkers((9, 6))), "squares": [9, 6], "square": "10 mm"}
    with pytest.raises(FrictrackError, match=said):
        plane_map(scale | change)


def test_pictures_that_are_none_or_of_another_size(tmp_path):
    scale = {"squares": [9, 6], "square": "10 mm"}
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(FrictrackError, match=r"text.png: expected a picture of the board but it cannot be read"):
        plane_map(scale | {"board": str(tmp_path / "text.png")})

    class Film:
        shape = (128, 256)

    with pytest.raises(FrictrackError, match=r"of 256x128 px, as the film has, but board\.png has 640x480 px"):
        plane_map(scale | {"board": drawn(tmp_path, checkers((9, 6)))}, film=Film())


def test_what_needs_pictures_is_checked_as_it_is_written():
    assert np.isnan(parse_scale({"board": "later.png", "squares": [9, 6], "square": "10 mm"})).all()
    assert np.isnan(parse_scale({"target": "40 mm"})).all()
    with pytest.raises(FrictrackError, match="expected the target's size along the course above 0 m"):
        parse_scale({"target": "0 mm"})


# ---- lens files


MATRIX = [[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]]
ROS = """image_width: 1280
image_height: 1024
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [{}]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [{}]
"""


def lens_file(folder: Path, kind: str) -> Path:
    path = folder / f"lens.{kind.rsplit(maxsplit=1)[-1]}"
    if kind == "plain json":
        path.write_text(json.dumps({"camera_matrix": MATRIX, "dist_coeffs": [LENS], "image_size": [1280, 1024]}))
    elif kind == "ROS yaml":
        path.write_text(ROS.format(*(", ".join(map(str, np.ravel(v).tolist())) for v in (MATRIX, LENS))))
    else:
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        file.write("image_width", 1280)
        file.write("image_height", 1024)
        file.write("camera_matrix", np.array(MATRIX, dtype=float))
        file.write("distortion_coefficients", np.array(LENS).reshape(-1, 1))
        file.release()
    return path


@pytest.mark.parametrize("kind", ["OpenCV's yml", "OpenCV's xml", "OpenCV's json", "plain json", "ROS yaml"])
def test_a_lens_file_undoes_the_distortion(tmp_path, kind):
    """A plane square to the camera, 0.5 m away: f/0.5 px per metre once the lens is undone, a percent off before."""
    lens = lens_file(tmp_path, kind)
    path = shot(PATH - [0.1, 0.1], np.eye(3), np.array([0, 0, 0.5]), LENS)
    made = plane_map(0.5 / FOCAL[0], lens=lens)
    assert made.length(path[[0, -1]])[0] == pytest.approx(0.15, rel=1e-9)
    assert abs(plane_map(0.5 / FOCAL[0]).length(path[[0, -1]])[0] / 0.15 - 1) > 0.008
    points = shot(CORNERS, *TILTED, LENS)
    places = plane_map({"points": points.tolist(), "plane": CORNERS.tolist()}, lens=lens)
    np.testing.assert_allclose(places(shot(PATH, *TILTED, LENS)), PATH, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "expected a lens file .* but cannot read it .No such file"),
        ("", "lens.yml: expected"),
        ("not: [a, lens", "lens.yml: expected OpenCV's yml, xml or json but it cannot be read"),
        ("{}", r"lens.yml: expected a camera matrix \(camera_matrix\) but the file holds nothing"),
        ('{"camera_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}', "expected distortion coefficients"),
        ('{"camera_matrix": [[1, 2], [3, 4]], "D": [0, 0, 0, 0]}', "expected a camera matrix .* in px"),
        ('{"camera_matrix": "big", "D": [0, 0, 0, 0]}', "expected a camera matrix as numbers but got big"),
        ('{"camera_matrix": [[9, 0, 1], [0, 9, 1], [0, 0, 1]], "D": [0, 0, 0]}', "4, 5, 8, 12, 14 .* but got 3"),
        ('{"K": [[9, 0, 1], [0, 9, 1], [0, 0, 1]], "D": [0, 0, 0, 0], "model": "fisheye"}', 'but got "fisheye"'),
        ('{"K": [[9, 0, 1], [0, 9, 1], [0, 0, 1]], "D": [0, 0, 0, 0], "image_size": [64, 48]}',
         "expected the lens of a 256x128 px film but got one calibrated on 64x48 px pictures"),
    ],
)  # fmt: skip
def test_lens_files_that_cannot_serve(tmp_path, text, said):
    class Film:
        shape = (128, 256)

    if text is not None:
        (tmp_path / "lens.yml").write_text(text)
    with pytest.raises(FrictrackError, match=said) as caught:
        plane_map("1 mm/px", lens=tmp_path / "lens.yml", film=Film())
    assert "\n" not in str(caught.value)
