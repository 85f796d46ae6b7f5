"""A camera written down anew, against which calibration is tested: pinhole, Brown's distortion, boards in its view."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FOCAL, CENTRE = np.array([1500.0, 1495.0]), np.array([630.0, 500.0])
SIZE = (1280, 1024)
NO_LENS = (0.0, 0.0, 0.0, 0.0, 0.0)
LENS = (-0.25, 0.12, 0.001, -0.0008, 0.02)  # k1 k2 p1 p2 k3


def turned(x: float, y: float, z: float) -> Floats:
    """Rotation by angles about x, then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x


def bowed(rays: Floats, lens: tuple[float, ...]) -> Floats:
    """Brown's distortion (1966) of normalised directions (n, 2)."""
    k1, k2, p1, p2, k3 = lens
    x, y = rays.T
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    at_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.stack([at_x, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1)


def shot(places: Floats, turn: Floats, shift: Floats, lens: tuple[float, ...] = NO_LENS) -> Floats:
    """Picture points (n, 2) px of places (n, 2) m on a plane."""
    before = np.column_stack([places, np.zeros(len(places))]) @ turn.T + shift
    return bowed(before[:, :2] / before[:, 2:], lens) * FOCAL + CENTRE


def homography(turn: Floats, shift: Floats, focal: float, size: tuple[int, int]) -> Floats:
    """From a plane (m) to a picture of so many px with its principal point in the middle."""
    matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    return matrix @ np.column_stack([turn[:, 0], turn[:, 1], shift])


def through(matrix: Floats, places: Floats) -> Floats:
    """Points (n, 2) through a homography."""
    there = np.column_stack([places, np.ones(len(places))]) @ matrix.T
    return there[:, :2] / there[:, 2:]


def pictured(board: NDArray[np.uint8], px: int, matrix: Floats, size: tuple[int, int]) -> NDArray[np.uint8]:
    """A board of `px` per square of 10 mm, seen through a homography: blurred, noisy, with a white rim."""
    fine, square = 4, 0.01
    board = cv2.copyMakeBorder(board, px, px, px, px, cv2.BORDER_CONSTANT, value=255)
    metres = np.array(
        [[square / px, 0, -(px - 0.5) * square / px], [0, square / px, -(px - 0.5) * square / px], [0, 0, 1]]
    )
    grown = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1]])
    large = (size[0] * fine, size[1] * fine)
    seen = cv2.warpPerspective(board.astype(np.float32), grown @ matrix @ metres, large, borderValue=180.0)
    seen = cv2.GaussianBlur(seen, (0, 0), 0.7 * fine).reshape(size[1], fine, size[0], fine).mean(axis=(1, 3))
    noise = np.random.default_rng(0).normal(0, 1, seen.shape)
    return np.clip(np.rint(20 + 0.8 * seen + noise), 0, 255).astype(np.uint8)


def checkers(squares: tuple[int, int], px: int = 40) -> NDArray[np.uint8]:
    """A checkerboard of so many squares along and across."""
    dark = np.add.outer(np.arange(squares[1] * px) // px, np.arange(squares[0] * px) // px) % 2
    return (255 * (1 - dark)).astype(np.uint8)


def charuco(squares: tuple[int, int], px: int = 40, legacy: bool = False) -> NDArray[np.uint8]:
    """A ChArUco board with markers of 7 in squares of 10 mm."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(squares, 0.01, 0.007, words)
    board.setLegacyPattern(legacy)
    return np.asarray(board.generateImage((squares[0] * px, squares[1] * px), marginSize=0), dtype=np.uint8)
