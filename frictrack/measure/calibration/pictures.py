"""Find in pictures what has a known size: the inner corners of a checkerboard or ChArUco board, or the target.

The width of the target is measured from edge to edge along the course. Its picture is the median of cut-outs over the
run, in which the background averages out. On each line along the course the two places are found at which the grey
value is half-way between background and target. The squared chords of a rectangle are constant from line to line; those
of a disc or ellipse form a parabola whose maximum is the diameter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.units import parse_quantity
from frictrack.measure.calibration.scale import board_files, board_squares, check_board
from frictrack.recording import Recording, open_recording
from frictrack.records import Array, Track

Grey = NDArray[np.uint8]

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")
MAX_PIXELS = 200_000_000  # of a picture
N_FRAMES = 40  # of a recording that are searched for the board
MAX_VIEWS = 20  # views that are used
MIN_BOARD_MOTION = 0.02  # of the picture's width that the board must move to be another view
REFINEMENT_REACH = 0.35  # of a square's side: half of the window in which a corner is refined
MIN_CHARUCO_CORNERS = 6


@dataclass(frozen=True, eq=False)
class BoardView:
    """One picture of the board.

    Attributes
    ----------
    name, number : str, int
        Name of the picture and its number in the series.
    points : array (n, 2)
        Corners (x, y) in the picture, px.
    places : array (n, 2)
        The same corners on the board, m.
    size : tuple of int
        Width and height of the picture, px.

    """

    name: str
    number: int
    points: Array
    places: Array
    size: tuple[int, int]  # width, height px


@dataclass(frozen=True)
class Board:
    """Board of known squares; a ChArUco board also has a dictionary and markers.

    Attributes
    ----------
    squares : tuple of int
        Number of squares along and across.
    square : float
        Side of a square, m.
    relative : float
        Relative standard deviation of the side.
    dictionary : str
        OpenCV's name of the marker dictionary; "" for a checkerboard.
    marker : float
        Side of a marker, m.

    """

    squares: tuple[int, int]
    square: float
    relative: float = 0.0  # standard deviation of the side over the side
    dictionary: str = ""
    marker: float = 0.0

    @property
    def kind(self) -> str:
        """Name of the kind of board."""
        return "ChArUco board" if self.dictionary else "checkerboard"

    @property
    def inner(self) -> tuple[int, int]:
        """Number of inner corners along and across."""
        return self.squares[0] - 1, self.squares[1] - 1

    def corners(self, grey: Grey) -> tuple[Array, Array] | None:
        """Find the corners of the board in a picture.

        Parameters
        ----------
        grey : array of uint8 (h, w)
            Picture.

        Returns
        -------
        tuple of array (n, 2) or None
            Corners in the picture (px) and on the board (m); None where the board is not found.

        """
        return self._charuco(grey) if self.dictionary else self._checker(grey, self.inner)

    def _checker(self, grey: Grey, inner: tuple[int, int]) -> tuple[Array, Array] | None:
        """Find all corners of a checkerboard (sector-based: Duda & Frese 2018, BMVC)."""
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, at = cv2.findChessboardCornersSB(grey, inner, flags=flags)
        if not found:
            return None
        column, row = np.meshgrid(np.arange(inner[0]), np.arange(inner[1]))
        places: Array = self.square * np.stack([column.ravel(), row.ravel()], axis=1).astype(np.float64)
        return _refined(grey, np.asarray(at, dtype=np.float32).reshape(inner[1], inner[0], 2)), places

    def _charuco(self, grey: Grey) -> tuple[Array, Array] | None:
        """Find the visible corners of a ChArUco board; part of it may be hidden."""
        for detector, places in self._detectors:
            at, numbers, _, _ = detector.detectBoard(grey)
            if numbers is not None and len(numbers) >= MIN_CHARUCO_CORNERS:
                return np.asarray(at, dtype=np.float64).reshape(-1, 2), places[np.ravel(numbers)]
        return None

    @cached_property
    def _detectors(self) -> list[tuple[Any, Array]]:
        """Detectors for both layouts that OpenCV has used for an even number of rows."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        out = []
        for legacy in (False, True):
            board = cv2.aruco.CharucoBoard(self.squares, self.square, self.marker, dictionary)
            board.setLegacyPattern(legacy)
            places = np.asarray(board.getChessboardCorners(), dtype=np.float64)[:, :2]
            out.append((cv2.aruco.CharucoDetector(board), places))
        return out

    def squares_hint(self, grey: Grey) -> str:
        """Suggest the right number of squares where the inner corners were counted instead.

        Parameters
        ----------
        grey : array of uint8 (h, w)
            Picture in which the board was not found.

        Returns
        -------
        str
            Text for an error message; "" where this is not the cause.

        """
        if self.dictionary or self._checker(grey, self.squares) is None:
            return ""
        columns, rows = (n + 1 for n in self.squares)
        return f"; it has {self.squares[0]} x {self.squares[1]} inner corners: write squares = [{columns}, {rows}]"


def _refined(grey: Grey, at: NDArray[np.float32]) -> Array:
    """Refine corners (rows, columns, 2) to the saddle points between four squares: three times more accurate."""
    side = min(float(np.min(np.linalg.norm(np.diff(at, axis=axis), axis=2))) for axis in (0, 1))
    reach = int(np.clip(REFINEMENT_REACH * side, 2, 15))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    fine = cv2.cornerSubPix(grey, at.reshape(-1, 1, 2).copy(), (reach, reach), (-1, -1), criteria)
    return np.asarray(fine, dtype=np.float64).reshape(-1, 2)


def parse_board(scale: Mapping[str, Any]) -> Board:
    """Create the board that a scale describes.

    Parameters
    ----------
    scale : mapping
        Scale by a board, with the keys board, squares and square.

    Returns
    -------
    Board
        With sides in m.

    Raises
    ------
    FrictrackError
        For impossible numbers of squares, lengths or dictionaries.

    Examples
    --------
    >>> parse_board({"board": "board.png", "squares": [9, 6], "square": "10 mm"}).inner
    (8, 5)

    """
    check_board(scale)
    square, std = parse_quantity(scale["square"], "m", "the side of a square")
    if "dictionary" not in scale:
        return Board(board_squares(scale), square, std / square)
    name = str(scale["dictionary"])
    known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
    if name not in known:
        raise FrictrackError(
            f'expected a dictionary such as DICT_4X4_50 but got "{name}"; known are {", ".join(known)}'
        )
    board = Board(
        board_squares(scale), square, std / square, name, parse_quantity(scale["marker"], "m", "the marker")[0]
    )
    markers = board.squares[0] * board.squares[1] // 2
    n_markers = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
    if n_markers < markers:
        raise FrictrackError(
            f"expected a dictionary of at least {markers} markers for this board but {name} has {n_markers}"
        )
    return board


FoundViews = tuple[list[BoardView], list[str]]  # views, and the names of pictures in which the board is not found


def find_views(scale: Mapping[str, Any], board: Board, shape: tuple[int, int] | None = None) -> FoundViews:
    """Find the board in all pictures.

    Parameters
    ----------
    scale : mapping
        Scale by a board.
    board : Board
        The same board, parsed.
    shape : tuple of int, optional
        Height and width of the film, px; the pictures must have the same size.

    Returns
    -------
    views : list of BoardView
        At most `MAX_VIEWS` that differ; the one in the plane of the course first.
    missed : list of str
        Names of pictures in which the board was not found.

    Raises
    ------
    FrictrackError
        Where no picture shows the board, the one in the plane does not, or sizes differ.

    """
    paths = tuple(board_files(scale))
    each = [p for path in paths for p in (sorted(path.iterdir()) if path.is_dir() else [path])]
    # runs of one camera share its board, which is searched once
    times = tuple(p.stat().st_mtime_ns for p in each if p.exists())
    return _cached_views(paths, times, scale.get("plane"), board, shape)


@lru_cache(maxsize=16)
def _cached_views(
    paths: tuple[Path, ...], _: tuple[int, ...], plane: int | None, board: Board, shape: tuple[int, int] | None
) -> FoundViews:
    path = paths[0]
    is_picture = path.suffix.lower() in PICTURE_SUFFIXES and _pages(path) == 1
    film = len(paths) == 1 and not path.is_dir() and not is_picture
    if plane is None and not film:
        plane = 0  # the first picture must show the board; a film may come to it late
    found: list[BoardView] = []
    missed: list[str] = []
    sizes: set[tuple[int, int]] = set()
    grey = np.zeros((0, 0), np.uint8)
    for number, name, grey in _frames(path, plane) if film else _pictures(paths, plane):
        sizes.add((grey.shape[1], grey.shape[0]))
        _check_size(name, sizes, shape)
        corners = board.corners(grey)
        if corners is None and number == plane:
            raise FrictrackError(_not_found(board, name, grey))
        if corners is None:
            missed.append(name)
            continue
        view = BoardView(name, number, *corners, (grey.shape[1], grey.shape[0]))
        if number == plane or all(_differs(view, other) for other in found):
            found.append(view)
    if not found:
        raise FrictrackError(_not_found(board, path.name, grey))
    return _select_views(found, plane), [] if film else missed


def _select_views(found: list[BoardView], plane: int | None) -> list[BoardView]:
    """Put the view in the plane of the course first, and limit the number of views."""
    chosen = next((v for v in found if v.number == plane), None)
    if plane is not None and chosen is None:
        raise FrictrackError(f"expected plane as the number of a picture of the board but got {plane}")
    rest = [v for v in found if v is not chosen]
    kept = rest if len(rest) < MAX_VIEWS else [rest[i] for i in np.linspace(0, len(rest) - 1, MAX_VIEWS).astype(int)]
    return [chosen, *kept[: MAX_VIEWS - 1]] if chosen else kept


def _check_size(name: str, sizes: set[tuple[int, int]], shape: tuple[int, int] | None) -> None:
    width, height = next(iter(sizes))
    if len(sizes) > 1:
        came = " and ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise FrictrackError(
            f"expected all pictures of the board from one camera setting but {name} makes them {came} px"
        )
    if shape is not None and (height, width) != shape:
        raise FrictrackError(
            f"expected the board in pictures of {shape[1]}x{shape[0]} px, as the film has, but {name} has "
            f"{width}x{height} px; photograph it with the camera set as for filming"
        )


def _not_found(board: Board, name: str, grey: Grey) -> str:
    columns, rows = board.squares
    check = "all of it must be in the picture, sharp, flat and evenly lit, with a white rim"
    if board.dictionary:
        check = f"check squares (along, then across) and dictionary ({board.dictionary}), focus and light"
    hint = board.squares_hint(grey)
    return f"expected a {board.kind} of {columns} x {rows} squares in {name} but found none; {check}{hint}"


def _differs(view: BoardView, other: BoardView) -> bool:
    """Whether the board was moved between two pictures."""
    if len(view.points) != len(other.points):
        return True
    moved = float(np.max(np.linalg.norm(view.points - other.points, axis=1)))
    return moved > MIN_BOARD_MOTION * view.size[0]


def _pictures(paths: tuple[Path, ...], plane: int | None) -> Iterator[tuple[int, str, Grey]]:
    """Number, name and grey picture of every file, or of all files in a folder."""
    if len(paths) == 1 and paths[0].is_dir():
        paths = tuple(sorted(p for p in paths[0].iterdir() if p.suffix.lower() in PICTURE_SUFFIXES))
    if not paths:
        raise FrictrackError("expected pictures of the board in its folder but found none")
    if plane is not None and plane >= len(paths):
        raise FrictrackError(f"expected plane as the number of one of {len(paths)} pictures but got {plane}")
    for number, path in enumerate(paths):
        yield number, path.name, _read_grey(path)


def _pages(path: Path) -> int:
    if path.suffix.lower() not in (".tif", ".tiff") or not path.exists():
        return 1
    try:
        return int(cv2.imcount(str(path)))
    except cv2.error:
        return 1


def _frames(path: Path, plane: int | None) -> Iterator[tuple[int, str, Grey]]:
    """Number, name and grey picture of frames spread over a recording."""
    recording = open_recording(path, fps=1.0)  # time does not matter here
    wanted = np.unique(np.linspace(0, recording.n_frames - 1, N_FRAMES).astype(int)).tolist()
    if plane is not None:
        if plane >= recording.n_frames:
            raise FrictrackError(f"expected plane as one of {recording.n_frames} frames of {path.name} but got {plane}")
        wanted = sorted({*wanted, plane})
    for number in wanted:
        yield number, f"{path.name}, frame {number}", _grey8(np.asarray(recording.frame(number)))


def _read_grey(path: Path) -> Grey:
    """Read a picture file as 8-bit grey values."""
    if not path.exists():
        raise FrictrackError(f"expected a picture of the board {path} but there is no such file; check the path")
    try:
        picture = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except (cv2.error, OSError):
        picture = None
    if picture is None or picture.size > MAX_PIXELS:
        raise FrictrackError(f"{path.name}: expected a picture of the board but it cannot be read as one")
    return _grey8(picture)


def _grey8(picture: NDArray[Any]) -> Grey:
    """Grey values in 8 bits; pictures with more bits are scaled to their maximum."""
    if picture.dtype == np.uint8:
        return np.ascontiguousarray(picture)
    top = max(float(np.max(picture)), 1.0)
    return np.asarray(np.rint(255.0 / top * picture), dtype=np.uint8)


N_CUTS = 48  # whose median is the picture
RIM_PX = 12  # beyond the rectangle, or a fifth of it where that is more
READINGS_PER_PX = 4  # readings per px along the course
EDGE_ERROR_PX = 0.15  # by which light and focus may move an edge
MIN_CONTRAST = 4.0  # noise of the background above which a line belongs to the target
READ_SHARE = 0.8  # of the rectangle's height that is read
MIN_LINES = 12  # lines on which the edge must be found
MIN_CURVATURE = 0.1  # of the squared chords, from which the target is a disc
MAX_EDGE_SIGMA_PX = 0.3  # an edge that is known no better is none
N_GROUPS = 6  # of lines, whose scatter is the uncertainty of the edge
PROFILE_REACH_PX, EDGE_ZONE_PX = 7, 3  # px from the edge within which its two levels are read


@dataclass(frozen=True, eq=False)
class TargetWidth:
    """Extent of the target along the course.

    Attributes
    ----------
    ends : array (2, 2)
        Both ends in the picture, px.
    std : float
        Standard deviation of the width, px.
    used : str
        Description for the user.

    """

    ends: Array
    std: float
    used: str


def target_width(track: Track, direction: Array, film: Recording | None = None) -> TargetWidth:
    """Measure the extent of the target along the course.

    Parameters
    ----------
    track : Track
        Track with the target's rectangle.
    direction : array (2,)
        Direction of the course in the picture.
    film : Recording, optional
        Film; without it the picture of the track is used.

    Returns
    -------
    TargetWidth
        Ends and standard deviation.

    Raises
    ------
    FrictrackError
        Where the outline does not contrast with the background on both sides.

    """
    if track.target is None or (film is None and track.picture is None):
        raise FrictrackError("expected a track with its target's rectangle for a scale by the target's size")
    picture = _median_picture(track, film) if film is not None else np.asarray(track.picture)
    course = np.asarray(direction, dtype=np.float64) / np.hypot(*direction)
    lines = _lines(picture, course, track.target[2:])
    (left, std_left), (right, std_right) = _edge(lines), _edge(lines[:, ::-1])
    chords = (lines.shape[1] - 1 - right - left) / READINGS_PER_PX
    width, shape = _width_and_shape(chords)
    std = float(np.sqrt(std_left**2 + std_right**2 + 2 * EDGE_ERROR_PX**2))
    middle = float(np.median(left - right)) / 2 / READINGS_PER_PX
    centre = np.array(track.target[:2]) + (np.array(track.target[2:]) - 1) / 2 + course * middle
    ends = np.stack([centre - course * width / 2, centre + course * width / 2])
    return TargetWidth(ends, std, f"{width:.2f} ± {std:.2f} px from edge to edge ({shape})")


def _median_picture(track: Track, film: Recording) -> Array:
    """Median (h, w) of cut-outs with a margin round the rectangle, registered to a small part of a pixel."""
    assert track.target is not None
    w, h = (round(s) for s in track.target[2:])
    size = tuple(s + 2 * max(RIM_PX, s // 5) for s in (w, h))
    half = (np.array(size) - 1) / 2 + 2
    at = np.stack([track.x_px, track.y_px], axis=1)
    room = np.array(film.shape[::-1]) - 1
    whole = np.flatnonzero(np.all((at - half >= 0) & (at + half <= room), axis=1))
    if len(whole) < 3:
        raise FrictrackError(
            "the target is nowhere in the film with a rim of background round it, so its size gives no scale; "
            'give a ruler as scale = {points = [[x, y], [x, y]], length = "100 mm"}'
        )
    chosen = np.unique(whole[_spread_rows(at[whole])])
    shift = [np.array([[1, 0, s[0]], [0, 1, s[1]]]) for s in at[chosen] - (np.array(size) - 1) / 2]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    cuts = [
        cv2.warpAffine(np.asarray(film.frame(int(i)), np.float32), m, size, flags=flags)
        for i, m in zip(chosen, shift, strict=True)
    ]
    return np.asarray(np.median(cuts, axis=0), dtype=np.float64)


def _spread_rows(at: Array) -> np.ndarray:
    """Rows spread over the path travelled."""
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    path = 0.9 * path / max(path[-1], 1e-9) + 0.1 * np.linspace(0, 1, len(path))
    return np.searchsorted(path, np.linspace(0, path[-1], N_CUTS)).clip(0, len(at) - 1)


def _lines(picture: Array, course: Array, size: tuple[float, ...]) -> Array:
    """Profiles (lines, n) along the course through the middle of the picture, `READINGS_PER_PX` per px."""
    across = np.array([-course[1], course[0]])
    middle = (np.array(picture.shape[::-1]) - 1) / 2
    high = READ_SHARE * float(np.abs(across) @ np.array(size)) / 2
    reach = min(m / max(abs(a), 1e-9) for m, a in zip(middle, course, strict=True))
    offsets = np.arange(-np.floor(high), np.floor(high) + 1)
    n = int(np.floor(reach * READINGS_PER_PX))
    s = np.arange(-n, n + 1) / READINGS_PER_PX
    at = middle + offsets[:, None, None] * across + s[None, :, None] * course
    lines = scipy.ndimage.map_coordinates(picture, [at[..., 1], at[..., 0]], order=3, mode="nearest")
    return np.asarray(lines, dtype=np.float64)


def _edge(lines: Array) -> tuple[Array, float]:
    """Find the left edge on each of the lines (n, m), then refine it on groups of aligned lines.

    Returns its reading number (n,) from the left, and its standard deviation, px.
    """
    rough = _first_edges(lines)
    good = np.flatnonzero(np.isfinite(rough))
    if len(good) < max(MIN_LINES, 0.6 * len(lines)):
        raise _no_outline()
    filled = np.interp(np.arange(len(lines)), good, rough[good])
    window = max(len(lines) // 3 // 2 * 2 + 1, 5)
    smooth = scipy.signal.savgol_filter(
        scipy.ndimage.median_filter(filled, size=min(window, 7), mode="nearest"), window, 2, mode="interp"
    )
    offset = np.arange(-PROFILE_REACH_PX * READINGS_PER_PX, PROFILE_REACH_PX * READINGS_PER_PX + 1)
    readings = np.arange(lines.shape[1])
    laid = np.array([np.interp(at + offset, readings, line) for at, line in zip(smooth, lines, strict=True)])
    found = np.array([_half_level(group.mean(axis=0)) for group in np.array_split(laid, N_GROUPS)])
    shifts, steps = found.T
    std = float(shifts.std(ddof=1) / np.sqrt(N_GROUPS) / READINGS_PER_PX)
    if not std < MAX_EDGE_SIGMA_PX or abs(np.sign(steps).sum()) < N_GROUPS:
        raise _no_outline()
    return smooth + shifts.mean(), std


def _no_outline() -> FrictrackError:
    """Error for a target whose outline does not contrast with the background."""
    return FrictrackError(
        "the target's outline does not stand out from the background on both sides, so its size gives no scale; "
        "give target = [x, y, w, h] round all of it, or a ruler: "
        'scale = {points = [[x, y], [x, y]], length = "100 mm"}'
    )


def _half_level(profile: Array) -> tuple[float, float]:
    """Shift of the half-level point from the middle of a profile, in readings; and the grey-value step."""
    flat = EDGE_ZONE_PX * READINGS_PER_PX
    middle = len(profile) // 2
    outside, inside = float(np.mean(profile[: middle - flat])), float(np.mean(profile[middle + flat :]))
    over = (profile - (outside + inside) / 2) * np.sign(inside - outside)
    turns = np.flatnonzero((over[:-1] < 0) & (over[1:] >= 0))
    if not len(turns):
        return float("nan"), inside - outside
    i = int(turns[np.argmin(np.abs(turns - middle))])
    return float(i - over[i] / (over[i + 1] - over[i]) - middle), inside - outside


def _first_edges(lines: Array) -> Array:
    """Reading number (lines,) at which each line first differs from its background; NaN where this is unclear."""
    rim = max(3 * READINGS_PER_PX // 2, 4)
    outside = np.median(lines[:, :rim], axis=1)
    noise = max(1.5 * float(np.median(np.abs(lines[:, :rim] - outside[:, None]))), 1.0)
    off = np.abs(lines - outside[:, None])[:, : lines.shape[1] * 3 // 4]
    level = np.maximum(0.5 * np.quantile(off[:, : lines.shape[1] // 2], 0.75, axis=1), MIN_CONTRAST * noise)
    first = np.argmax(off > level[:, None], axis=1).astype(np.float64)
    return np.where(np.any(off > level[:, None], axis=1) & (first >= READINGS_PER_PX), first, np.nan)


def _width_and_shape(chords: Array) -> tuple[float, str]:
    """Width of the target, px, and the shape from which it was read."""
    u = np.linspace(-1.0, 1.0, len(chords))
    c, b, a = np.polyfit(u, chords**2, 2)
    left = chords**2 - np.polyval([c, b, a], u)
    if -c > MIN_CURVATURE * a and np.std(left) < 0.2 * abs(c) and abs(b) < -2 * c:
        return float(np.sqrt(a - b**2 / (4 * c))), "round: its diameter"
    return float(np.median(chords)), "straight: the middle chord"
