"""Read camera matrix and lens distortion from a calibration file of OpenCV or similar programs.

Calibrate camera, lens and the plane of the course from views of a board.

Several views determine camera matrix, lens distortion (Brown-Conrady: Brown 1971, Photogramm. Eng. 37:855) and the
poses of the board together (Zhang 2000, IEEE PAMI 22:1330, through OpenCV). The covariance follows from the residuals
of all corners. One view determines a homography, and one radial coefficient if the view is suitable.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

from frictrack.base.errors import FrictrackError
from frictrack.base.files import read_small_text
from frictrack.measure.calibration.pictures import Board, BoardView
from frictrack.measure.calibration.scale import (
    MAX_RADIAL_COEFFICIENT,
    Homography,
    Normalisation,
    PlaneMap,
    fit_view,
    project,
)
from frictrack.records import Array

MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "camera_Matrix", "intrinsic_matrix", "mtx", "K", "M1")
DISTORTION = (
    "distortion_coefficients", "dist_coeffs", "distCoeffs", "dist_coeff", "Distortion_Coefficients", "dist", "D", "D1",
)  # fmt: skip
WIDTH, HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)  # of a distortion, k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 .. s4 [taux tauy]]]]
MAX_FILE_BYTES = 1_000_000
MAX_NESTING = 50  # brackets in brackets; a matrix has two
STOP_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
MAX_ROUND_TRIP_PX = 0.01  # a point undistorted and distorted again must come back this near


@dataclass(frozen=True, eq=False)
class Lens:
    """Calibrated lens with the Brown-Conrady distortion model.

    Attributes
    ----------
    matrix : array (3, 3)
        Camera matrix, px.
    distortion : array (k,)
        Coefficients in OpenCV's order: k1, k2, p1, p2, k3, ...
    size : tuple of int or None
        Width and height of the pictures to which it applies, px.

    References
    ----------
    D. C. Brown, "Close-range camera calibration", Photogramm. Eng. 37 (1971), 855-866.

    """

    matrix: Array
    distortion: Array
    size: tuple[int, int] | None = None

    def rays(self, points: Array) -> Array:
        """Compute normalised directions of picture points.

        Parameters
        ----------
        points : array (n, 2)
            Points in the picture, px.

        Returns
        -------
        array (n, 2)
            NaN where the distortion cannot be inverted.

        """
        flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 2)
        if not len(flat):
            return np.zeros((0, 2))
        rays: Array = np.asarray(
            cv2.undistortPoints(flat, self.matrix, self.distortion, criteria=STOP_CRITERIA), dtype=np.float64
        ).reshape(-1, 2)
        off = np.linalg.norm(self.project_rays(rays) - flat[:, 0], axis=1)
        return np.where((off < MAX_ROUND_TRIP_PX)[:, None], rays, np.nan)

    def project_rays(self, rays: Array) -> Array:
        """Project normalised directions (n, 2) to picture points (n, 2) px."""
        solid = np.column_stack([rays, np.ones(len(rays))])
        points, _ = cv2.projectPoints(solid, np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.asarray(points, dtype=np.float64).reshape(-1, 2)

    def undistorted(self, points: Array) -> Array:
        """Remove the distortion from picture points (n, 2) px."""
        focal, centre = np.diag(self.matrix)[:2], self.matrix[:2, 2]
        return self.rays(points) * focal + centre


def read_lens(path: Path, shape: tuple[int, int] | None = None) -> Lens:
    """Read a lens from OpenCV's YAML, XML or JSON, or from a JSON of lists.

    Parameters
    ----------
    path : Path
        Calibration file.
    shape : tuple of int, optional
        Height and width of the film, px; the lens must be calibrated for this size.

    Returns
    -------
    Lens
        Camera matrix and distortion.

    Raises
    ------
    FrictrackError
        For a missing or unreadable file, another lens model, or another picture size.

    """
    fields = _fields(path)
    matrix = _field(fields, MATRIX, path, "a camera matrix")
    distortion = _field(fields, DISTORTION, path, "distortion coefficients").ravel()
    camera = matrix.reshape(3, 3) if matrix.size == 9 else np.zeros((3, 3))
    has_focus = np.all(np.isfinite(camera)) and camera[0, 0] > 0 and camera[1, 1] > 0
    if not has_focus or np.any(camera[2] != [0, 0, 1]):
        raise FrictrackError(f"{path.name}: expected a camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px")
    _check_model(path, fields, distortion)
    size = _size(fields, path)
    if size and shape and size != shape[::-1]:
        raise FrictrackError(
            f"{path.name}: expected the lens of a {shape[1]}x{shape[0]} px film but got one calibrated on "
            f"{size[0]}x{size[1]} px pictures; calibrate with the camera set as for filming"
        )
    return Lens(camera, distortion, size)


def _check_model(path: Path, fields: dict[str, Any], distortion: Array) -> None:
    model = str(fields.get("distortion_model", fields.get("model", "")))
    if model in ("equidistant", "fisheye", "kannala_brandt"):
        raise FrictrackError(f'{path.name}: expected the usual lens model (k1, k2, p1, p2, k3) but got "{model}"')
    if distortion.size not in COEFFICIENT_COUNTS or not np.all(np.isfinite(distortion)):
        counts = ", ".join(str(n) for n in COEFFICIENT_COUNTS)
        raise FrictrackError(f"{path.name}: expected {counts} distortion coefficients but got {distortion.size}")


def _field(fields: dict[str, Any], names: tuple[str, ...], path: Path, what: str) -> Array:
    value = next((fields[name] for name in names if name in fields), None)
    if value is None:
        came = ", ".join(list(fields)[:8]) or "nothing"
        raise FrictrackError(f"{path.name}: expected {what} ({names[0]}) but the file holds {came}")
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as e:
        raise FrictrackError(f"{path.name}: expected {what} as numbers but got {str(value)[:60]}") from e


def _size(fields: dict[str, Any], path: Path) -> tuple[int, int] | None:
    width, height = (next((fields[n] for n in names if n in fields), None) for names in (WIDTH, HEIGHT))
    if width is None or height is None:
        pair = fields.get("image_size", fields.get("img_size"))
        width, height = pair if isinstance(pair, list) and len(pair) == 2 else (None, None)
    if not width or not height:
        return None
    try:
        return int(width), int(height)
    except (TypeError, ValueError, OverflowError) as e:
        raise FrictrackError(f"{path.name}: expected the size of the pictures in px but got {width} x {height}") from e


def _fields(path: Path) -> dict[str, Any]:
    """Top-level names of the file with their numbers, texts and matrices (as lists)."""
    text = read_small_text(path, MAX_FILE_BYTES, "a lens file")
    try:
        return _parsed(text.lstrip())
    except (ValueError, yaml.YAMLError, ElementTree.ParseError, AttributeError, TypeError, RecursionError) as e:
        raise FrictrackError(f"{path.name}: expected OpenCV's yml, xml or json but it cannot be read as such") from e


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """YAML loader without aliases, by which a short text can expand without limit."""

    def fetch_alias(self) -> None:
        """Reject aliases with a YAMLError."""
        raise yaml.YAMLError("references are not read")

    def construct_matrix(self, node: yaml.Node) -> Any:
        """Numbers of OpenCV's matrix type."""
        return self.construct_mapping(node, deep=True).get("data")


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_matrix)


def _parsed(text: str) -> dict[str, Any]:
    """Parse XML, JSON or YAML, without its first line as ROS writes it, to names and their values.

    OpenCV's own parser may hang.
    """
    steps = (1 if bracket in "[{" else -1 for bracket in re.findall(r"[\[\]{}]", text))
    if max(accumulate(steps), default=0) > MAX_NESTING:  # the time of a parser grows with the square of the depth
        raise ValueError("brackets without end")
    if text.startswith("<?xml"):
        return {child.tag: _element(child) for child in ElementTree.fromstring(text)}
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    found = json.loads(text) if text.startswith("{") else yaml.load("\n".join(lines), _Loader)
    if not isinstance(found, dict):
        raise ValueError("no names at the top")
    return {str(name): v["data"] if isinstance(v, dict) and "data" in v else v for name, v in found.items()}


def _element(element: ElementTree.Element) -> Any:
    """Value of an XML element: a matrix, a list, a number or a text."""
    data = element.find("data")
    if data is not None:
        return (data.text or "").split()
    text = (element.text or "").strip()
    try:
        return float(text)
    except ValueError:
        return text.strip('"')


MIN_VIEWS = 3
MAX_DISTORTION_SIGMA = 0.01  # standard deviation of the distortion in the corners that one view may have
MAX_FOCAL_ERROR = 0.2  # relative standard deviation of the focal length above which the views do not determine it
N_INTRINSICS = 9  # fx, fy, cx, cy, k1, k2, p1, p2, k3
MAX_REPROJECTION_PX = 1.0  # a larger reprojection error is reported
MIN_CORNER_SIGMA_PX = 0.02  # a corner is known no better than this (print, light, detection)
TOO_FEW_VIEWS = (
    "the pictures do not determine the camera (at least three are needed, tilted differently): only one is used"
)


def plane_from_views(views: list[BoardView], board: Board, lens: Lens | None = None) -> PlaneMap:
    """Compute the map to the plane of the first view.

    Parameters
    ----------
    views : list of BoardView
        Views of the board, that in the plane of the course first.
    board : Board
        The board.
    lens : Lens, optional
        Lens that was calibrated before.

    Returns
    -------
    PlaneMap
        Picture points (px) to points of the plane (m), with covariance.

    Raises
    ------
    FrictrackError
        For too few corners, or a lens file that does not fit.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE Trans. Pattern Anal. Mach. Intell. 22 (2000),
    1330-1334.

    """
    plane = _from_known_lens(views[0], lens, board) if lens else _from_all_views(views, board)
    if plane is None:
        plane = _from_one_view(views[0], board)
        plane = replace(plane, notes=(*plane.notes, TOO_FEW_VIEWS)) if len(views) > 1 else plane
    return plane.read_at(views[0].points, zero=(0.0, 0.0)).with_relative_error(board.relative)


def _from_one_view(first: BoardView, board: Board) -> PlaneMap:
    """Fit a homography to one view, with a radial coefficient if the view determines it well."""
    unit_sigma = np.ones(len(first.points))
    width, height = first.size
    frame = Normalisation(np.array([(width - 1) / 2, (height - 1) / 2]), float(np.hypot(width, height) / 2))
    without_radial = fit_view(first.points, first.places, unit_sigma)
    with_radial = fit_view(first.points, first.places, unit_sigma, lens=frame)
    k = float(with_radial.map.values[-1])
    std = float(np.sqrt(with_radial.map.covariance[-1, -1] * _variance(with_radial)))
    determined = std < MAX_DISTORTION_SIGMA and abs(k) < MAX_RADIAL_COEFFICIENT
    chosen = with_radial if determined else without_radial
    distortion = (
        f"radial distortion {1e2 * k:+.2f} ± {1e2 * std:.2g} % in the corners, from this one picture"
        if determined
        else "without lens distortion, which one picture does not determine; several tilted pictures would"
    )
    used = (
        f"scale by a {board.kind}, {len(unit_sigma)} corners in {first.name}, {chosen.rms:.2g} px from the plane; "
        f"{distortion}"
    )
    covariance = chosen.map.covariance * _variance(chosen)
    return replace(chosen.map, covariance=covariance, used=used, notes=_reprojection_note(chosen.rms))


def _variance(fitted: Homography) -> float:
    """Variance of a corner along one axis, px^2."""
    if fitted.degrees < 1:
        raise FrictrackError("expected more corners of the board in its picture; show more of it")
    return max(fitted.chi2 / fitted.degrees, MIN_CORNER_SIGMA_PX**2)


def _from_all_views(views: list[BoardView], board: Board) -> PlaneMap | None:
    """Fit camera, lens and pose to several views; None where these do not determine the camera."""
    best = _calibrated(views) if len(views) >= MIN_VIEWS else None
    covariance = None if best is None else _covariance(views, *best[:2])
    if best is None or covariance is None:
        return None
    lens, poses, rms = best
    m = lens.matrix
    values = np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *lens.distortion, *poses[0]])
    if np.sqrt(covariance[0, 0]) > MAX_FOCAL_ERROR * values[0]:
        return None

    depth = float(poses[0, 5])
    used = (
        f"scale by a {board.kind} in {len(views)} pictures, {sum(len(v.points) for v in views)} corners, reprojected "
        f"to {rms:.2g} px; camera, lens (k1, k2, p1, p2, k3) and plane ({views[0].name}) fitted together; it is "
        f"about {1e3 * depth:.0f} mm away: 1 mm between it and the target changes lengths by {0.1 / depth:.2g} %"
    )
    return PlaneMap(values, covariance, _by_camera, used=used, notes=_reprojection_note(rms))


def _calibrated(views: list[BoardView]) -> tuple[Lens, Array, float] | None:
    """Fit lens, poses (v, 6) and rms distance (px) with OpenCV; None where no solution has all boards in front."""
    solid = [_solid(v).astype(np.float32) for v in views]
    seen = [v.points.astype(np.float32).reshape(-1, 1, 2) for v in views]
    start = cv2.initCameraMatrix2D(solid, seen, views[0].size)
    try:
        rms, matrix, distortion, rotations, translations = cv2.calibrateCamera(
            solid, seen, views[0].size, start, np.zeros(5), criteria=STOP_CRITERIA
        )
    except cv2.error:
        return None
    poses = np.array([[*np.ravel(r), *np.ravel(t)] for r, t in zip(rotations, translations, strict=True)])
    if not (np.isfinite(rms) and np.all(np.isfinite(matrix)) and np.all(poses[:, 5] > 0)):
        return None
    return Lens(np.asarray(matrix, np.float64), np.ravel(distortion).astype(np.float64)[:5]), poses, float(rms)


def _covariance(views: list[BoardView], lens: Lens, poses: Array, intrinsics: int = N_INTRINSICS) -> Array | None:
    """Covariance of the fitted numbers of camera and lens and of the first pose, fitted with all other poses."""
    rows, misfits = [], []
    for k, view in enumerate(views):
        slopes, misfit = _corner_slopes(view, lens, poses[k])
        of_poses = np.zeros((len(misfit), 6 * len(views)))
        of_poses[:, 6 * k : 6 * k + 6] = slopes[:, :6]
        rows.append(np.hstack([slopes[:, 6 : 6 + intrinsics], of_poses]))
        misfits.append(misfit)
    every, misfit = np.vstack(rows), np.concatenate(misfits)
    size, count = np.linalg.norm(every, axis=0), len(misfit) - every.shape[1]
    if count < 1 or not np.all(size > 0):
        return None
    inverse = np.linalg.pinv((every / size).T @ (every / size), rcond=1e-14, hermitian=True) / np.outer(size, size)
    kept = intrinsics + 6
    return np.asarray(inverse[:kept, :kept] * max(float(misfit @ misfit) / count, MIN_CORNER_SIGMA_PX**2))


def _corner_slopes(view: BoardView, lens: Lens, pose: Array) -> tuple[Array, Array]:
    """Derivatives of the corners (2 n, ...) by the pose (6), then by camera and lens (9); and residuals (2 n,), px."""
    at, slopes = cv2.projectPoints(_solid(view), pose[:3], pose[3:], lens.matrix, lens.distortion)[:2]
    return np.asarray(slopes, np.float64), (np.asarray(at, np.float64).reshape(-1, 2) - view.points).ravel()


def _solid(view: BoardView) -> Array:
    """Places of the corners in space (n, 3), m."""
    return np.column_stack([view.places, np.zeros(len(view.places))])


def _on_plane(rays: Array, pose: Array) -> Array:
    """Intersect directions (n, 2) with the plane z = 0 of a board in a pose (6,), m; NaN behind the camera."""
    turn = cv2.Rodrigues(np.ascontiguousarray(pose[:3]))[0]
    views = np.column_stack([turn[:, 0], turn[:, 1], pose[3:]])
    inverse = np.linalg.inv(views)
    return project(inverse * np.sign(inverse[2] @ (pose[3:] / pose[5])), rays)


def _from_known_lens(first: BoardView, lens: Lens, board: Board) -> PlaneMap:
    """Fit the pose of the board with a known lens."""
    if lens.size and lens.size != first.size:
        raise FrictrackError(
            f"expected the board in pictures of {lens.size[0]}x{lens.size[1]} px, as the lens was calibrated on, but "
            f"{first.name} has {first.size[0]}x{first.size[1]} px; use the same setting of the camera"
        )
    rays = lens.rays(first.points)
    if not np.all(np.isfinite(rays)):
        raise FrictrackError(f"the lens file cannot undo the distortion at the board in {first.name}; check the file")
    found, turn, shift = cv2.solvePnP(_solid(first), rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        raise FrictrackError(f"the board in {first.name} does not fit the lens file; check the file")
    turn, shift = cv2.solvePnPRefineLM(_solid(first), first.points, lens.matrix, lens.distortion, turn, shift)
    pose = np.array([*np.ravel(turn), *np.ravel(shift)], dtype=np.float64)
    covariance = _covariance([first], lens, pose[None], intrinsics=0)
    assert covariance is not None  # a view has more corners than its pose has numbers
    rms = float(np.sqrt(2 * np.mean(_corner_slopes(first, lens, pose)[1] ** 2)))
    used = (
        f"scale by a {board.kind}, {len(first.points)} corners in {first.name}, reprojected to {rms:.2g} px "
        "with the lens taken as exact"
    )
    return PlaneMap(pose, covariance, partial(_by_pose, lens), used=used, notes=_reprojection_note(rms))


def _by_pose(lens: Lens, pose: Array, points: Array) -> Array:
    return _on_plane(lens.rays(points), pose)


def _by_camera(values: Array, points: Array) -> Array:
    fx, fy, cx, cy = values[:4]
    lens = Lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), values[4:N_INTRINSICS])
    return _on_plane(lens.rays(points), values[N_INTRINSICS:])


def _reprojection_note(rms: float) -> tuple[str, ...]:
    if rms <= MAX_REPROJECTION_PX:
        return ()
    return (
        f"the board's corners fit to {rms:.1f} px only: check that it is flat and sharp, and that squares is right",
    )
