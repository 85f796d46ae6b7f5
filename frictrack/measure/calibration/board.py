"""Find the inner corners of a checkerboard or ChArUco board in pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.measure.calibration.scale import board_files, board_squares, check_board, parse_length
from frictrack.recording import open_recording
from frictrack.records import Array

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
    square, std = parse_length(scale["square"], "the side of a square")
    if "dictionary" not in scale:
        return Board(board_squares(scale), square, std / square)
    name = str(scale["dictionary"])
    known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
    if name not in known:
        raise FrictrackError(
            f'expected a dictionary such as DICT_4X4_50 but got "{name}"; known are {", ".join(known)}'
        )
    board = Board(board_squares(scale), square, std / square, name, parse_length(scale["marker"], "the marker")[0])
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
    return _cached_views(paths, _modification_times(paths), scale.get("plane"), board, shape)


def _modification_times(paths: tuple[Path, ...]) -> tuple[int, ...]:
    """Modification times of the files: runs of one camera share its board, which is searched once."""
    each = [p for path in paths for p in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return tuple(p.stat().st_mtime_ns for p in each if p.exists())


@lru_cache(maxsize=16)
def _cached_views(
    paths: tuple[Path, ...],
    _: tuple[int, ...],
    plane: int | None,
    board: Board,
    shape: tuple[int, int] | None,
) -> FoundViews:
    film = _is_film(paths)
    if plane is None and not film:
        plane = 0  # the first picture must show the board; a film may come to it late
    found: list[BoardView] = []
    missed: list[str] = []
    sizes: set[tuple[int, int]] = set()
    grey = np.zeros((0, 0), np.uint8)
    for number, name, grey in _frames(paths[0], plane) if film else _pictures(paths, plane):
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
        raise FrictrackError(_not_found(board, paths[0].name, grey))
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


def _is_film(paths: tuple[Path, ...]) -> bool:
    return (
        len(paths) == 1
        and not paths[0].is_dir()
        and (paths[0].suffix.lower() not in PICTURE_SUFFIXES or _pages(paths[0]) > 1)
    )


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
