"""Calibrate camera, lens and the plane of the course from views of a board.

Several views determine camera matrix, lens distortion (Brown-Conrady: Brown 1971, Photogramm. Eng. 37:855) and the
poses of the board together (Zhang 2000, IEEE PAMI 22:1330, through OpenCV). The covariance follows from the residuals
of all corners. One view determines a homography, and one radial coefficient if the view is suitable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from frictrack.calibration.board import Board, BoardView
from frictrack.calibration.homography import MAX_RADIAL_COEFFICIENT, Homography, Normalisation, fit_view
from frictrack.calibration.lens import Lens
from frictrack.calibration.plane import PlaneMap, project
from frictrack.errors import FrictrackError
from frictrack.records import Array

MIN_VIEWS = 3
MAX_DISTORTION_SIGMA = 0.01  # standard deviation of the distortion in the corners that one view may have
MAX_FOCAL_ERROR = 0.2  # relative standard deviation of the focal length above which the views do not determine it
N_INTRINSICS = 9  # fx, fy, cx, cy, k1, k2, p1, p2, k3
MAX_REPROJECTION_PX = 1.0  # a larger reprojection error is reported
MIN_CORNER_SIGMA_PX = 0.02  # a corner is known no better than this (print, light, detection)
TOO_FEW_VIEWS = (
    "the pictures do not determine the camera (at least three are needed, tilted differently): only one is used"
)


@dataclass(frozen=True, eq=False)
class _Camera:
    """Camera fitted to views: lens, poses (v, 6), and reprojection error."""

    lens: Lens
    poses: Array
    rms: float  # px, of the distance


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
    points = views[0].points
    middle, reach = points.mean(axis=0), float(np.hypot(*np.ptp(points, axis=0)))
    plane = replace(plane, centre=(float(middle[0]), float(middle[1])), zero=(0.0, 0.0), reach=reach)
    return plane.scaled(1.0, board.relative)


def _from_one_view(first: BoardView, board: Board) -> PlaneMap:
    """Fit a homography to one view, with a radial coefficient if the view determines it well."""
    unit_sigma = np.ones(len(first.points))
    width, height = first.size
    frame = Normalisation(np.array([(width - 1) / 2, (height - 1) / 2]), float(np.hypot(width, height) / 2))
    without_radial = fit_view(first.points, first.places, unit_sigma)
    with_radial = fit_view(first.points, first.places, unit_sigma, lens=frame)
    k, std = (
        float(with_radial.map.values[-1]),
        float(np.sqrt(with_radial.map.covariance[-1, -1] * _variance(with_radial))),
    )
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
    if best is None:
        return None
    covariance = _covariance(views, best)
    values = np.concatenate([_intrinsics(best.lens), best.poses[0]])
    if covariance is None or np.sqrt(covariance[0, 0]) > MAX_FOCAL_ERROR * values[0]:
        return None
    depth = float(best.poses[0, 5])
    used = (
        f"scale by a {board.kind} in {len(views)} pictures, {sum(len(v.points) for v in views)} corners, reprojected "
        f"to {best.rms:.2g} px; camera, lens (k1, k2, p1, p2, k3) and plane ({views[0].name}) fitted together; it is "
        f"about {1e3 * depth:.0f} mm away: 1 mm between it and the target changes lengths by {0.1 / depth:.2g} %"
    )
    return PlaneMap(values, covariance, _points_on_plane, used=used, notes=_reprojection_note(best.rms))


def _calibrated(views: list[BoardView]) -> _Camera | None:
    """Fit camera, lens and poses with OpenCV; None where no solution has all boards before the camera."""
    solid = [np.column_stack([v.places, np.zeros(len(v.places))]).astype(np.float32) for v in views]
    without_radial = [v.points.astype(np.float32).reshape(-1, 1, 2) for v in views]
    start = cv2.initCameraMatrix2D(solid, without_radial, views[0].size)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    try:
        rms, matrix, distortion, rotations, translations = cv2.calibrateCamera(
            solid, without_radial, views[0].size, start, np.zeros(5), criteria=criteria
        )
    except cv2.error:
        return None
    poses = np.array([[*np.ravel(r), *np.ravel(t)] for r, t in zip(rotations, translations, strict=True)])
    if not (np.isfinite(rms) and np.all(np.isfinite(matrix)) and np.all(poses[:, 5] > 0)):
        return None
    return _Camera(Lens(_floats(matrix), _floats(distortion).ravel()[:5]), poses, float(rms))


def _intrinsics(lens: Lens) -> Array:
    m = lens.matrix
    return np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *lens.distortion])


def _covariance(views: list[BoardView], camera: _Camera) -> Array | None:
    """Covariance (15, 15) of camera, lens and first pose; all other poses are eliminated (Schur complement)."""
    normal = np.zeros((N_INTRINSICS, N_INTRINSICS))
    square, count = 0.0, -N_INTRINSICS
    own = cross = None
    for k, v in enumerate(views):
        pose, lens, misfit = _corner_jacobians(v, camera, k)
        square, count = square + float(misfit @ misfit), count + len(misfit) - 6
        normal += lens.T @ lens
        if k == 0:
            own, cross = pose.T @ pose, lens.T @ pose
        else:
            normal -= lens.T @ pose @ np.linalg.pinv(pose.T @ pose, hermitian=True) @ pose.T @ lens
    assert own is not None
    assert cross is not None
    whole = np.block([[normal, cross], [cross.T, own]])
    size = np.sqrt(np.diag(whole))
    if count < 1 or not np.all(size > 0):
        return None
    inverse = np.linalg.pinv(whole / np.outer(size, size), rcond=1e-14, hermitian=True) / np.outer(size, size)
    return np.asarray(inverse * max(square / count, MIN_CORNER_SIGMA_PX**2))


def _corner_jacobians(v: BoardView, camera: _Camera, k: int) -> tuple[Array, Array, Array]:
    """Derivatives of the corners (2 n,) by the pose (2 n, 6) and by camera and lens (2 n, 9); residuals."""
    solid = np.column_stack([v.places, np.zeros(len(v.places))])
    pose = camera.poses[k]
    at, slopes = cv2.projectPoints(solid, pose[:3], pose[3:], camera.lens.matrix, camera.lens.distortion)[:2]
    slopes, at = _floats(slopes), _floats(at).reshape(-1, 2)
    return slopes[:, :6], slopes[:, 6 : 6 + N_INTRINSICS], (at - v.points).ravel()


def _floats(raw: Any) -> Array:
    return np.asarray(raw, dtype=np.float64)


def _points_on_plane(values: Array, points: Array) -> Array:
    """Project picture points to the plane z = 0 of a board, m."""
    lens = Lens(np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]]), values[4:N_INTRINSICS])
    return _on_plane(lens.rays(points), values[N_INTRINSICS:])


def _on_plane_through(lens: Lens, pose: Array, points: Array) -> Array:
    return _on_plane(lens.rays(points), pose)


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
    solid = np.column_stack([first.places, np.zeros(len(first.places))])
    rays = lens.rays(first.points)
    if not np.all(np.isfinite(rays)):
        raise FrictrackError(f"the lens file cannot undo the distortion at the board in {first.name}; check the file")
    found, turn, shift = cv2.solvePnP(solid, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        raise FrictrackError(f"the board in {first.name} does not fit the lens file; check the file")
    turn, shift = cv2.solvePnPRefineLM(solid, first.points, lens.matrix, lens.distortion, turn, shift)
    pose = np.concatenate([np.ravel(turn), np.ravel(shift)])
    at, slopes = cv2.projectPoints(solid, pose[:3], pose[3:], lens.matrix, lens.distortion)[:2]
    misfit = (at.reshape(-1, 2) - first.points).ravel()
    normal = slopes[:, :6].T @ slopes[:, :6]
    covariance = np.linalg.inv(normal) * max(float(misfit @ misfit) / (len(misfit) - 6), MIN_CORNER_SIGMA_PX**2)
    rms = float(np.sqrt(2 * np.mean(misfit**2)))
    used = (
        f"scale by a {board.kind}, {len(first.points)} corners in {first.name}, reprojected to {rms:.2g} px "
        "with the lens taken as exact"
    )
    return PlaneMap(pose, covariance, partial(_on_plane_through, lens), used=used, notes=_reprojection_note(rms))


def _reprojection_note(rms: float) -> tuple[str, ...]:
    if rms <= MAX_REPROJECTION_PX:
        return ()
    return (
        f"the board's corners fit to {rms:.1f} px only: check that it is flat and sharp, and that squares is right",
    )
