"""Read camera matrix and lens distortion from a calibration file of OpenCV or similar programs."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

from frictrack.errors import FrictrackError
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
    if matrix.size != 9 or not _is_camera(matrix.reshape(3, 3)):
        raise FrictrackError(f"{path.name}: expected a camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px")
    _check_model(path, fields, distortion)
    size = _size(fields, path)
    if size and shape and size != shape[::-1]:
        raise FrictrackError(
            f"{path.name}: expected the lens of a {shape[1]}x{shape[0]} px film but got one calibrated on "
            f"{size[0]}x{size[1]} px pictures; calibrate with the camera set as for filming"
        )
    return Lens(matrix.reshape(3, 3), distortion, size)


def _check_model(path: Path, fields: dict[str, Any], distortion: Array) -> None:
    model = str(fields.get("distortion_model", fields.get("model", "")))
    if model in ("equidistant", "fisheye", "kannala_brandt"):
        raise FrictrackError(f'{path.name}: expected the usual lens model (k1, k2, p1, p2, k3) but got "{model}"')
    if distortion.size not in COEFFICIENT_COUNTS or not np.all(np.isfinite(distortion)):
        counts = ", ".join(str(n) for n in COEFFICIENT_COUNTS)
        raise FrictrackError(f"{path.name}: expected {counts} distortion coefficients but got {distortion.size}")


def _is_camera(matrix: Array) -> bool:
    return bool(
        np.all(np.isfinite(matrix)) and matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.all(matrix[2] == [0, 0, 1])
    )


def _field(fields: dict[str, Any], names: tuple[str, ...], path: Path, what: str) -> Array:
    value = next((fields[name] for name in names if name in fields), None)
    if value is None:
        came = ", ".join(list(fields)[:8]) or "nothing"
        raise FrictrackError(f"{path.name}: expected {what} ({names[0]}) but the file holds {came}")
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as e:
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
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise FrictrackError(f"{path.name}: expected a lens file but it has {path.stat().st_size / 1e6:.0f} MB")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as e:
        raise FrictrackError(f"{path.name}: expected a lens file of text (OpenCV's yml, xml or json)") from e
    except OSError as e:
        raise FrictrackError(f"expected a lens file {path} but cannot read it; check the path") from e
    try:
        if _nesting(text) > MAX_NESTING:
            raise ValueError("brackets without end")
        fields = _json(text) if text.lstrip().startswith("{") else _yaml_or_xml(text)
    except (ValueError, yaml.YAMLError, ElementTree.ParseError, AttributeError, TypeError, RecursionError) as e:
        raise FrictrackError(f"{path.name}: expected OpenCV's yml, xml or json but it cannot be read as such") from e
    return fields


def _nesting(text: str) -> int:
    """Largest depth of nested brackets: the time of a parser grows with its square."""
    steps = (1 if bracket in "[{" else -1 for bracket in re.findall(r"[\[\]{}]", text))
    return max(accumulate(steps), default=0)


def _json(text: str) -> dict[str, Any]:
    return _plain_matrices(json.loads(text))


def _plain_matrices(found: dict[str, Any]) -> dict[str, Any]:
    """Replace matrices by their numbers."""
    return {str(name): v["data"] if isinstance(v, dict) and "data" in v else v for name, v in found.items()}


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """YAML loader without aliases, by which a short text can expand without limit."""

    def fetch_alias(self) -> None:
        """Reject aliases with a YAMLError."""
        raise yaml.YAMLError("references are not read")

    def construct_matrix(self, node: yaml.Node) -> Any:
        """Numbers of OpenCV's matrix type."""
        return self.construct_mapping(node, deep=True).get("data")


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_matrix)


def _yaml_or_xml(text: str) -> dict[str, Any]:
    """Parse OpenCV's format, or YAML without its first line as ROS writes it. OpenCV's own parser may hang."""
    if text.lstrip().startswith("<?xml"):
        return {child.tag: _element(child) for child in ElementTree.fromstring(text)}
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    found = yaml.load("\n".join(lines), _Loader)
    if not isinstance(found, dict):
        raise ValueError("no names at the top")
    return _plain_matrices(found)


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
