"""Parse a scale, and map the picture to the plane of the course: by a number, a ruler, or points at known places.

A map is a function of some values (a pitch, a homography, a camera and its pose) and of picture points. The covariance
of the values gives the uncertainty of every length that is measured through it.

A homography is fitted to points at known places. The errors are those of the picture points, and their squares are
minimised in the picture, on normalised coordinates (Hartley & Zisserman 2004, Multiple View Geometry, 4.2 and 4.4). One
radial coefficient k of the lens, p = c + (q - c)(1 + k |q - c|^2 / R^2), can be fitted as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy

from frictrack.base.distributions import chi2_sf
from frictrack.base.errors import FrictrackError
from frictrack.base.units import parse_quantity
from frictrack.records import Array

Place = Callable[[Array, Array], Array]

DIFFERENCE_STEP = 0.01  # of central differences: px, and the share of a standard deviation


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """Map from picture points (px, y down) to points of the course's plane (m).

    Attributes
    ----------
    values : array (k,)
        Parameters of the calibration.
    covariance : array (k, k)
        Their covariance.
    place : callable
        ``place(values, points)`` maps points (n, 2) px to (n, 2) m; NaN beyond the horizon.
    used : str
        Description of the data from which it was made.
    centre : tuple of float
        Picture point at which directions are transformed to the plane, px.
    zero : tuple of float or None
        Origin in the plane, m; None for the corner of the picture.
    reach : float
        Length that was measured in the picture, px; 0 where it does not matter.
    notes : tuple of str
        Notes for the user.

    """

    values: Array
    covariance: Array
    place: Place
    used: str = ""
    centre: tuple[float, float] = (0.0, 0.0)
    zero: tuple[float, float] | None = None
    reach: float = 0.0
    notes: tuple[str, ...] = ()

    def __call__(self, points: Array) -> Array:
        """Map picture points (n, 2) px to points of the plane (n, 2) m."""
        return self.place(self.values, np.asarray(points, dtype=np.float64))

    def jacobian(self, points: Array) -> Array:
        """Compute the derivative of the plane by the picture.

        Parameters
        ----------
        points : array (n, 2)
            Picture points, px.

        Returns
        -------
        array (n, 2, 2)
            m/px.

        """
        points = np.asarray(points, dtype=np.float64)
        sides = [(self(points + d) - self(points - d)) / (2 * DIFFERENCE_STEP) for d in DIFFERENCE_STEP * np.eye(2)]
        return np.stack(sides, axis=2)

    def pitch(self, at: Array, direction: Array) -> float:
        """Compute the pitch at a picture point along a direction.

        Parameters
        ----------
        at : array (2,)
            Picture point, px.
        direction : array (2,)
            Direction in the picture.

        Returns
        -------
        float
            m/px.

        """
        step_px = np.asarray(direction, dtype=np.float64)
        return float(np.linalg.norm(self.jacobian(np.reshape(at, (1, 2)))[0] @ step_px) / np.linalg.norm(step_px))

    def length(self, ends: Array) -> tuple[float, float]:
        """Compute the distance of two picture points in the plane.

        Parameters
        ----------
        ends : array (2, 2)
            Picture points, px.

        Returns
        -------
        length : float
            m.
        relative : float
            Relative standard deviation from the covariance of the values (linear propagation).

        """
        length = _distance(self.place(self.values, ends))
        slope = np.zeros(len(self.values))
        for k in range(len(slope)):
            std = float(np.sqrt(self.covariance[k, k]))
            step = np.zeros(len(self.values))
            step[k] = DIFFERENCE_STEP * std
            if std > 0:
                far, near = (_distance(self.place(self.values + s, ends)) for s in (step, -step))
                slope[k] = (far - near) / (2 * DIFFERENCE_STEP * std)
        return length, float(np.sqrt(max(float(slope @ self.covariance @ slope), 0.0))) / length

    def with_relative_error(self, relative: float) -> PlaneMap:
        """The map times a factor of 1 whose standard deviation is `relative`; the factor is one more value."""
        k = len(self.values)
        covariance = np.zeros((k + 1, k + 1))
        covariance[:k, :k], covariance[k, k] = self.covariance, relative**2
        place = partial(_times_last_value, self.place)
        return replace(self, values=np.append(self.values, 1.0), covariance=covariance, place=place)

    def read_at(self, points: Array, zero: tuple[float, float] | None = None) -> PlaneMap:
        """The map with the picture points (n, 2) px at which it was read, and the origin in the plane."""
        centre = points.mean(axis=0)
        reach = float(np.hypot(*np.ptp(points, axis=0)))
        return replace(self, centre=(float(centre[0]), float(centre[1])), reach=reach, zero=zero)


Straight = Callable[[Array], Array]  # picture points (n, 2) px -> where a lens without distortion shows them


def as_seen(points: Array) -> Array:
    """Picture points without a lens to correct."""
    return points


def project(matrix: Array, points: Array) -> Array:
    """Points (n, 2) through a homography (3, 3); NaN beyond the horizon (where the sign of w is not the matrix's)."""
    x, y, w = (points @ matrix[:, :2].T + matrix[:, 2]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((w > 0)[:, None], np.stack([x / w, y / w], axis=1), np.nan)


def _distance(ends: Array) -> float:
    return float(np.linalg.norm(ends[1] - ends[0]))


Scale = str | float | Mapping[str, Any] | Sequence[Any]
KINDS: Mapping[str, tuple[frozenset[str], frozenset[str]]] = {
    "ruler": (frozenset({"points", "length"}), frozenset({"click"})),
    "points": (frozenset({"points", "plane"}), frozenset({"click", "unit"})),
    "target": (frozenset({"target"}), frozenset()),
    "board": (frozenset({"board", "squares", "square"}), frozenset({"dictionary", "marker", "plane"})),
}  # keys that must and may be there
EXAMPLES = (
    '"0.5 mm/px", {points = [[x, y], [x, y]], length = "100 mm"}, {target = "40 mm"}, '
    '{board = "board.png", squares = [9, 6], square = "10 mm"} or {points = [four of them], plane = [[X, Y], ...]}'
)
TARGET_SIZE = "the target's size along the course"
DEFAULT_CLICK = "0.5 px"  # standard deviation of a click, along x and along y
MIN_RULER_SHARE = 0.2  # of the path: a shorter ruler gets a note


def parse_scale(scale: Scale | None) -> tuple[float, float]:
    """Parse a scale as far as possible without pictures.

    Parameters
    ----------
    scale : str, float, mapping or sequence
        ``"0.5 mm/px"``, ``"0.500 +/- 0.002 mm/px"``, a number in m/px, or a ruler
        ``{"points": [[x, y], [x, y]], "length": "100 +/- 0.1 mm", "click": "0.5 px"}``.

    Returns
    -------
    pitch : float
        m/px; NaN for scales that need a picture (target, board, points with plane), whose syntax is checked only.
    relative : float
        Relative standard deviation; for a ruler it includes the two clicks.

    Raises
    ------
    FrictrackError
        For anything else.

    Examples
    --------
    >>> parse_scale("0.5 mm/px")
    (0.0005, 0.0)

    """
    kind, written = scale_kind(scale), cast(Any, scale)
    if kind == "number":
        value, std = parse_quantity(written, "m/px", "the scale", above=0.0)
        return value, std / value
    if kind == "ruler":
        made = map_from_ruler(written)
        return made.pitch(np.zeros(2), np.array([1.0, 0.0])), made.length(np.array([[0.0, 0.0], [1.0, 0.0]]))[1]
    if kind == "several":
        return [parse_scale(part) for part in written][0]  # noqa: RUF015 - all are checked
    CHECKS[kind](written)
    return float("nan"), float("nan")


def scale_kind(scale: Any) -> str:
    """Determine the kind of a scale.

    Parameters
    ----------
    scale
        Scale as the user gave it.

    Returns
    -------
    str
        "number", "ruler", "points", "target", "board" or "several".

    Raises
    ------
    FrictrackError
        For a missing scale or wrong keys.

    Examples
    --------
    >>> scale_kind({"target": "40 mm"})
    'target'

    """
    if scale is None:
        raise FrictrackError(
            'expected a scale but got none; give scale = "0.5 mm/px", or two points of known distance as '
            '{points = [[x, y], [x, y]], length = "100 mm"}'
        )
    if isinstance(scale, list | tuple) and scale:
        return "several"
    if not isinstance(scale, Mapping):
        return "number"
    keys = frozenset(scale)
    for kind, (needed, allowed) in KINDS.items():
        if needed <= keys <= needed | allowed:
            return kind
    raise FrictrackError(_describe_wrong_keys(keys))


def _describe_wrong_keys(keys: frozenset[str]) -> str:
    """Describe what is wrong with the keys: the nearest kind, and its missing or unknown keys."""
    words = {"board": {"board", "squares", "square"}, "target": {"target"}, "points": {"plane"}}
    nearest_kind = next((kind for kind, marks in words.items() if keys & marks), "ruler")
    needed, allowed = KINDS[nearest_kind]
    lacking, foreign = sorted(needed - keys), sorted(keys - needed - allowed)
    if not keys & (needed | allowed):
        return f"expected a scale as {EXAMPLES} but got the keys {', '.join(sorted(keys)) or 'none'}"
    if foreign:
        known = ", ".join(sorted(needed | allowed))
        return f"expected a scale by {nearest_kind} with the keys {known} but got {', '.join(foreign)} too"
    missing = " and ".join(map(repr, lacking))
    return f"expected a scale by {nearest_kind} with {' and '.join(sorted(needed))} but {missing} is missing"


def map_from_number(scale: Any, straight: Straight = as_seen) -> PlaneMap:
    """Create the map of a scale that is a number.

    Parameters
    ----------
    scale : str or float
        Such as ``"0.5 mm/px"``.
    straight : callable
        Removes lens distortion from points (n, 2) px.

    Returns
    -------
    PlaneMap
        Map with the same pitch everywhere.

    """
    value, std = parse_quantity(scale, "m/px", "the scale", above=0.0)
    return PlaneMap(np.array([value]), np.array([[std**2]]), partial(_scaled, straight))


# Maps are partial functions of these, not closures, so that results can be pickled.


def _times_last_value(place: Callable[[Array, Array], Array], values: Array, points: Array) -> Array:
    return np.asarray(values[-1] * place(values[:-1], points))


def _scaled(straight: Straight, values: Array, points: Array) -> Array:
    return np.asarray(values[0] * straight(points))


def _by_length(straight: Straight, values: Array, points: Array) -> Array:
    return np.asarray(values[0] / _distance(straight(values[1:].reshape(2, 2))) * straight(points))


def map_from_ruler(scale: Mapping[str, Any], straight: Straight = as_seen) -> PlaneMap:
    """Create the map of two points at a known distance; its values are the length and the four coordinates.

    Parameters
    ----------
    scale : mapping
        Points, length and optional click.
    straight : callable
        Removes lens distortion from points (n, 2) px.

    Returns
    -------
    PlaneMap
        Map with the same pitch everywhere.

    """
    points = _picture_points(scale["points"], 2)
    length, std = parse_quantity(scale["length"], "m", "the length between the two points", above=0.0)
    click = click_std(scale)
    distance = float(np.hypot(*(points[1] - points[0])))
    if not distance > 0:
        raise FrictrackError(f"expected two different points for the scale but got {scale['points']!r}")

    used = f"scale by a ruler of {1e3 * length:g} mm over {distance:.0f} px, clicked to {click:g} px"
    return replace(map_from_length((length, std), points, click, straight), used=used).read_at(points)


def map_from_length(length: tuple[float, float], ends: Array, click: float, straight: Straight) -> PlaneMap:
    """Create the map of a length (m, and its deviation) between two picture points (2, 2) px known to `click` px."""
    covariance = np.diag([length[1] ** 2] + 4 * [click**2])
    return PlaneMap(np.array([length[0], *ends.ravel()]), covariance, partial(_by_length, straight))


def _picture_points(raw: Any, min_count: int) -> Array:
    """Parse points (n, 2) px of the picture: exactly two, or at least `min_count`."""
    wanted = "two points [[x, y], [x, y]]" if min_count == 2 else f"at least {min_count} points [[x, y], ...]"
    try:
        points = np.asarray(raw, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FrictrackError(f"expected points as [[x, y], [x, y]] but got {raw!r}") from error
    if points.ndim != 2 or points.shape[1] != 2 or not np.all(np.isfinite(points)):
        raise FrictrackError(f"expected points as [[x, y], [x, y]] but got {raw!r}")
    if len(points) < min_count or (min_count == 2 and len(points) > 2):
        raise FrictrackError(f"expected {wanted} but got {len(points)}")
    return points


def click_std(scale: Mapping[str, Any]) -> float:
    """Return the standard deviation of a click, px."""
    return parse_quantity(
        scale.get("click", DEFAULT_CLICK), "px", "click, the standard deviation of a click,", above=0.0
    )[0]


def _plane_points(scale: Mapping[str, Any]) -> tuple[Array, Array]:
    """Parse places (n, 2) m of points on the plane, and their standard deviations (n, 2) m.

    Numbers are in metres or in the `unit` of the scale; texts have their own unit.
    """
    raw, unit = scale["plane"], scale.get("unit", "m")
    factor = parse_quantity(f"1 {unit}", "m", "the unit of plane")[0]
    if not isinstance(raw, list | tuple) or any(not isinstance(p, list | tuple) or len(p) != 2 for p in raw):
        raise FrictrackError(f"expected plane as places [[X, Y], ...] but got {raw!r}")

    def place(v: Any) -> tuple[float, float]:
        value, std = parse_quantity(v, "m", "a place on the plane")
        return (value, std) if isinstance(v, str) else (value * factor, std)

    both = np.array([[place(v) for v in pair] for pair in raw], dtype=np.float64).reshape(-1, 2, 2)
    return both[..., 0], both[..., 1]


def check_points(scale: Mapping[str, Any]) -> tuple[Array, Array, Array]:
    """Parse points of known place: picture points (n, 2) px, places (n, 2) m, and the places' standard deviations."""
    points = _picture_points(scale["points"], 4)
    places, std = _plane_points(scale)
    click_std(scale)
    if len(points) != len(places):
        raise FrictrackError(f"expected as many places as points but got {len(places)} for {len(points)} points")
    return points, places, std


def board_squares(scale: Mapping[str, Any]) -> tuple[int, int]:
    """Return the number of squares along and across the board."""
    raw = scale["squares"]
    whole = isinstance(raw, list | tuple) and len(raw) == 2 and all(type(n) is int for n in raw)
    min_count = 3 if "dictionary" in scale else 4
    if not whole or min(raw) < min_count or max(raw) > 100:
        raise FrictrackError(
            f"expected squares as their number along and across, {min_count} to 100 each, such as [9, 6], "
            f"but got {raw!r}"
        )
    return raw[0], raw[1]


def check_board(scale: Mapping[str, Any]) -> None:
    """Check the description of a board; its pictures are read later."""
    board_squares(scale)
    square, _ = parse_quantity(scale["square"], "m", "the side of a square", above=0.0)
    if ("dictionary" in scale) != ("marker" in scale):
        raise FrictrackError("expected both dictionary and marker for a ChArUco board, neither for a checkerboard")
    marker, _ = parse_quantity(scale.get("marker", 1e-3 * square), "m", "the side of a marker", above=0.0)
    if marker >= square:
        raise FrictrackError(f"expected a marker smaller than its square but got {scale['marker']!r}")
    if type(scale.get("plane", 0)) is not int or scale.get("plane", 0) < 0:
        raise FrictrackError(f"expected plane as the number of a picture (the first is 0) but got {scale['plane']!r}")
    board_files(scale)


def board_files(scale: Mapping[str, Any]) -> list[Path]:
    """Return the files with the pictures of a board."""
    raw = scale["board"]
    files = list(raw) if isinstance(raw, list | tuple) else [raw]
    if not files or not all(isinstance(part, str | Path) and str(part) for part in files):
        raise FrictrackError(f"expected board as a picture, several, a folder or a recording but got {raw!r}")
    return [Path(part) for part in files]


CHECKS: Mapping[str, Callable[[Any], Any]] = {
    "points": check_points,
    "target": lambda scale: parse_quantity(scale["target"], "m", TARGET_SIZE, above=0.0),
    "board": check_board,
}


MIN_ASPECT = 0.02  # extent of the points across over that lengthwise; less is one line
N_PARAMETERS = 8  # of a homography
NEWTON_STEPS = 20
UNDETERMINED = "the points do not determine the plane: three of four lie on one line; spread them"
MAX_RADIAL_COEFFICIENT = 0.3  # a larger k is no lens


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Normalise coordinates to order one: (points - middle) / size."""

    middle: Array
    size: float

    def __call__(self, points: Array) -> Array:
        """Normalise points (n, 2)."""
        return np.asarray((points - self.middle) / self.size, dtype=np.float64)

    def restore(self, points: Array) -> Array:
        """Undo the normalisation of points (n, 2)."""
        return np.asarray(points * self.size + self.middle, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Homography:
    """Fitted view of a plane.

    Attributes
    ----------
    map : PlaneMap
        Map from the picture to the plane.
    rms : float
        Rms distance of the points, px.
    chi2 : float
        Sum of squares over the given variances.
    degrees : int
        Degrees of freedom.

    """

    map: PlaneMap
    rms: float  # px, of the distance
    chi2: float  # sum of squares over the variances that were given
    degrees: int


def fit_view(
    points: Array, places: Array, sigma: Array, straight: Straight = as_seen, lens: Normalisation | None = None
) -> Homography:
    """Fit the view of a plane to points at known places.

    Parameters
    ----------
    points : array (n, 2)
        Points in the picture, px.
    places : array (n, 2)
        The same points on the plane, m.
    sigma : array (n,)
        Standard deviation of each point along x and y, px.
    straight : callable
        Removes the distortion of a known lens from points (n, 2) px.
    lens : Normalisation, optional
        Middle of the picture and distance to a corner. If it is given, one radial coefficient is fitted.

    Returns
    -------
    Homography
        The map and its quality.

    Raises
    ------
    FrictrackError
        Where the points do not determine a plane before the camera.

    References
    ----------
    R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision (2004), ch. 4.

    """
    _check_spread(points, "points")
    _check_spread(places, "places on the plane")
    straightened = straight(points)
    if not np.all(np.isfinite(straightened)):
        raise FrictrackError("the lens file cannot undo the distortion at the points of the scale; check the file")
    plane, picture, seen = _norm(places), _norm(straightened), straightened if lens is None else points
    flat = plane(places)

    def residual(values: Array) -> Array:
        at = picture.restore(project(_matrix(values), flat))
        at = at if lens is None else _distort(float(values[N_PARAMETERS]), at, lens)
        return np.nan_to_num(((at - seen) / sigma[:, None]).T.ravel(), nan=1e6)

    start = np.append(_linear(flat, picture(straightened)), [0.0] * (lens is not None))
    found = scipy.optimize.least_squares(residual, start, method="lm", x_scale="jac", xtol=1e-14, ftol=1e-14)
    place = partial(_by_homography, plane, picture, straight, lens)
    covariance = _covariance(np.asarray(found.jac, dtype=np.float64))
    fitted = PlaneMap(found.x, covariance, place).read_at(points, zero=(0.0, 0.0))
    misfit = found.fun.reshape(2, -1)
    rms = float(np.sqrt(2 * np.mean((misfit * sigma) ** 2)))
    return Homography(fitted, rms, float(np.sum(misfit**2)), misfit.size - len(found.x))


def _by_homography(
    plane: Normalisation,
    picture: Normalisation,
    straight: Straight,
    lens: Normalisation | None,
    values: Array,
    points: Array,
) -> Array:
    straightened = straight(points) if lens is None else _undistort(float(values[N_PARAMETERS]), points, lens)
    return plane.restore(project(_inverse(values), picture(straightened)))


def _covariance(slopes: Array) -> Array:
    """Covariance of parameters by the derivatives (n, k) of the residuals."""
    normal = slopes.T @ slopes
    size = np.sqrt(np.diag(normal))
    if not np.all(size > 0) or np.linalg.cond(normal / np.outer(size, size)) > 1e13:
        raise FrictrackError(UNDETERMINED)
    return np.asarray(np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size))


def _distort(k: float, points: Array, lens: Normalisation) -> Array:
    """Apply the radial coefficient k to straight points (n, 2) px."""
    q = lens(points)
    return lens.restore(q * (1 + k * np.sum(q**2, axis=1, keepdims=True)))


def _undistort(k: float, points: Array, lens: Normalisation) -> Array:
    """Remove the radial coefficient k from points (n, 2) px: Newton's method on r (1 + k r^2) = r_seen."""
    straightened = lens(points)
    radius = np.linalg.norm(straightened, axis=1)
    r = radius.copy()
    for _ in range(NEWTON_STEPS):
        r -= (r * (1 + k * r**2) - radius) / np.maximum(1 + 3 * k * r**2, 0.1)
    return lens.restore(straightened / (1 + k * r**2)[:, None])


def _matrix(values: Array) -> Array:
    return np.append(values[:N_PARAMETERS], 1.0).reshape(3, 3)


def _inverse(values: Array) -> Array:
    """Matrix from the picture to the plane, with w > 0 where the middle of the points is visible."""
    inverse = np.linalg.inv(_matrix(values))
    return np.asarray(inverse * np.sign(inverse[2] @ [values[2], values[5], 1.0]), dtype=np.float64)


def _linear(places: Array, points: Array) -> Array:
    """Parameters (8,) of a homography with h33 = 1 through normalised places and points, from which the fit starts."""
    import cv2  # noqa: PLC0415 - tables do without

    h = cv2.findHomography(places, points)[0]
    if h is None:
        raise FrictrackError(UNDETERMINED)
    if np.any(places @ h[2, :2] + h[2, 2] <= 0):
        raise FrictrackError(
            "no camera can see the places where the points are; check that points and plane come in the same order"
        )
    return np.asarray(h.ravel()[:N_PARAMETERS] / h[2, 2], dtype=np.float64)


def _norm(points: Array) -> Normalisation:
    middle = points.mean(axis=0)
    return Normalisation(middle, float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))))


def _check_spread(points: Array, what: str) -> None:
    strength = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not strength[1] > MIN_ASPECT * strength[0]:
        raise FrictrackError(f"expected {what} that span a plane but all of them lie on one line; add one beside it")


ALPHA_MISFIT = 1e-3  # significance level at which the points fit worse than they were clicked


def from_points(scale: Mapping[str, Any], straight: Straight = as_seen) -> PlaneMap:
    """Compute the map of ``{points = [[x, y], ...], plane = [[X, Y], ...]}``.

    Parameters
    ----------
    scale : mapping
        Points in the picture (px) and their places on the plane.
    straight : callable
        Removes the distortion of a known lens from points (n, 2) px.

    Returns
    -------
    PlaneMap
        With five or more points their misfit is tested; a significant one enlarges the covariance and gives a note.

    Raises
    ------
    FrictrackError
        For points that do not determine a plane.

    """
    points, places, std = check_points(scale)
    click = click_std(scale)
    sigma = np.full(len(points), click)
    fitted = fit_view(points, places, sigma, straight)
    if np.any(std > 0):  # uncertain places count as clicks that are as uncertain
        pitch = np.sqrt(np.abs(np.linalg.det(fitted.map.jacobian(points))))
        sigma = np.sqrt(click**2 + np.mean(std**2, axis=1) / pitch**2)
        fitted = fit_view(points, places, sigma, straight)
    used, degrees = f"scale by {len(points)} points of known place, clicked to {click:g} px", fitted.degrees
    if degrees == 0:
        return replace(fitted.map, used=f"{used}; a fifth point would show whether they fit")
    used += f"; they fit to {fitted.rms:.2g} px"
    if chi2_sf(fitted.chi2, degrees) >= ALPHA_MISFIT:
        return replace(fitted.map, used=used)
    variance_ratio = fitted.chi2 / degrees
    note = (
        f"the points of the scale lie {np.sqrt(variance_ratio):.1f} times as far off as clicks of {click:g} px would: "
        "check places, order and lens; the uncertainty of the scale is enlarged by that"
    )
    return replace(fitted.map, used=used, covariance=fitted.map.covariance * variance_ratio, notes=(note,))
