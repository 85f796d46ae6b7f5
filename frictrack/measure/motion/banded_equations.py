"""The data of a structural smoother, its banded equations part by part, and variances of their unknowns.

Of the equations K1 of the first part, A of its last unknowns with those of the next part, and K2 of the next part,
eliminating the first part changes only the first corner of the next one, K2 - A' K1^-1 A, and so on: a block LU
factorisation (Golub & Van Loan 2013, Matrix Computations, section 4.5). So only one part of a long record is held at a
time, and the solution is that of all equations at once.

Variances of combinations of neighbouring unknowns need only the inverse near its diagonal, in O(n). Eliminating all
unknowns on one side of a block changes only the corner of its equations that they couple to (Takahashi, Fagan & Chen
1973, PICA 8, compute the same elements one by one). With the corners of both sides, the inverse of two neighbouring
blocks equals that part of the full inverse. Several matrices of one size are treated at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.records import Array

TREND_ORDER = 4  # order of the difference that the trend keeps small; it has as many free coefficients


def penalty(cutoff: float, interval: float) -> float:
    """Penalty lambda at which half of the amplitude passes at a cut-off.

    Examples
    --------
    >>> round(cutoff_of(penalty(50.0, 1e-3), 1e-3), 9)
    50.0

    """
    return float((2.0 * np.sin(np.pi * cutoff * interval)) ** (-2 * TREND_ORDER))


def cutoff_of(lam: float, interval: float) -> float:
    """Cut-off (Hz) of a penalty lambda, the inverse of `penalty`; at most half the frame rate."""
    half = 0.5 * float(lam) ** (-0.5 / TREND_ORDER)
    return float(np.arcsin(min(half, 1.0)) / np.pi / interval)


def response(omega: Array, lam: float) -> Array:
    """Share of the amplitude that a trend of penalty lambda passes at frequencies omega, radians per frame."""
    return np.asarray(1.0 / (1.0 + lam * (2.0 * np.sin(omega / 2.0)) ** (2 * TREND_ORDER)))


@dataclass(frozen=True, eq=False)
class LineParameters:
    """Frequencies omega (K,), radians per frame, and penalties mu (K,) of K lines."""

    omega: Array
    mu: Array


NO_LINES = LineParameters(np.empty(0), np.empty(0))


@dataclass(frozen=True)
class NoiseColour:
    """White noise plus a first-order autoregressive process, with unit variance together.

    Attributes
    ----------
    correlation
        Correlation of neighbouring frames of the autoregressive part, rho.
    share
        Its share of the variance.

    """

    correlation: float
    share: float

    def spectrum(self, omega: Array) -> Array:
        """Spectral density at frequencies omega, radians per frame; 1 on average."""
        response = np.abs(1.0 - self.correlation * np.exp(-1j * omega)) ** 2
        return np.asarray(1.0 - self.share + self.share * (1.0 - self.correlation**2) / response)

    @property
    def shocks(self) -> float:
        """Variance of the innovations c_j - rho c_(j-1) over that of the noise."""
        return self.share * (1.0 - self.correlation**2)

    def log_likelihood_cost(self, measured: int, n: int) -> float:
        """Determinant term in twice the negative log-likelihood of n frames, of which some were measured."""
        return float((n - 1) * np.log(self.shocks) + np.log(self.share) + measured * np.log(1.0 - self.share))

    def sample(self, white: Array, driving: Array) -> Array:
        """Generate such noise."""
        innovations = np.concatenate([np.sqrt(self.share) * driving[:1], np.sqrt(self.shocks) * driving[1:]])
        correlated = scipy.signal.lfilter([1.0], [1.0, -self.correlation], innovations, axis=0)
        return np.asarray(np.sqrt(1.0 - self.share) * white + correlated)


@dataclass(frozen=True, eq=False)
class SmootherData:
    """Measurements to smooth.

    Attributes
    ----------
    y, w
        Positions and their weights, each (n,); the weight is 0 where none was measured.
    second_differences, second_difference_weights
        Second differences of the position by a sensor, and their weights, each (n - 2,); weight 0 where unknown.
    colour
        Colour of the noise; None for white noise.

    """

    y: Array
    w: Array
    second_differences: Array | None = None
    second_difference_weights: Array | None = None
    colour: NoiseColour | None = None

    @property
    def precision(self) -> Array:
        """Weights (n,) with respect to the white part of the noise."""
        return self.w / (1.0 - self.colour.share) if self.colour else self.w

    def part(self, first: int, stop: int) -> SmootherData:
        """The data of frames first to stop (exclusive)."""
        sensor = (self.second_differences, self.second_difference_weights)
        bent, weights = (None if q is None else q[first : stop - 2] for q in sensor)
        return SmootherData(self.y[first:stop], self.w[first:stop], bent, weights, self.colour)

    def probes(self, rng: np.random.Generator, many: int) -> Array:
        """Random series (n, many) with the covariance of the noise, from random signs."""
        white = rng.choice([-1.0, 1.0], (len(self.w), many))
        return self.colour.sample(white, rng.choice([-1.0, 1.0], white.shape)) if self.colour else white

    def apply_inverse_covariance(self, y: Array) -> Array:
        """Multiply columns by the inverse covariance of unit noise.

        Parameters
        ----------
        y
            Columns, (n, ...).

        Returns
        -------
        Array
            Products, (n, ...).

        """
        weighted = weighted_columns(self.precision, y)
        if not self.colour:
            return weighted
        n, rho, inverse_innovation = len(self.w), self.colour.correlation, 1.0 / self.colour.shocks
        banded = np.zeros((3, n))
        banded[0, 1:] = banded[2, :-1] = -rho * inverse_innovation
        banded[1] = self.precision + inverse_innovation * (1.0 + rho**2 * (np.arange(n) < n - 1))
        banded[1, 0] += 1.0 / self.colour.share - inverse_innovation
        flat = scipy.linalg.solve_banded((1, 1), banded, weighted.reshape(n, -1)).reshape(weighted.shape)
        return weighted - weighted_columns(self.precision, flat)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(np.sum(self.w > 0)) + (
            0 if self.second_difference_weights is None else int(np.sum(self.second_difference_weights > 0))
        )


def weighted_columns(w: Array, y: Array) -> Array:
    """Weights (n,) times columns (n, ...)."""
    return np.asarray(w.reshape(-1, *[1] * (y.ndim - 1)) * y)


CUBIC_FRAMES = 1 << 16  # taken at once to fit a cubic


def weighted_cubic(y: Array, w: Array) -> Array:
    """Fit a weighted least-squares cubic; smoothers leave it unchanged, but it would cost digits."""
    u = np.linspace(-1.0, 1.0, len(y))
    triangle: Array = np.empty((0, TREND_ORDER + 1))  # of the QR factors of the frames so far
    for first in range(0, len(y), CUBIC_FRAMES):
        rows = slice(first, first + CUBIC_FRAMES)
        equations = np.column_stack([np.vander(u[rows], TREND_ORDER), np.where(w[rows] > 0, y[rows], 0.0)])
        rows_so_far = np.concatenate([triangle, equations * np.sqrt(w[rows, None])])
        triangle = np.asarray(np.linalg.qr(rows_so_far, mode="r"))
    return np.asarray(np.polyval(np.linalg.lstsq(triangle[:, :-1], triangle[:, -1])[0], u))


FOURTH_DIFFERENCE, SECOND_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), np.array([1.0, -2.0, 1.0])
BLOCK_FRAMES = 8  # frames per block of the covariance
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class EquationPart:
    """Equations of some frames of a record.

    Attributes
    ----------
    frames
        The frames.
    components
        Positions of their unknowns, by component.
    differences
        Rows of each difference among all of the record, and positions of their unknowns.
    bands
        Coefficients in LAPACK band storage, (3 band + 1, size); the top rows are for fill-in.
    before, after
        Coefficients of the last unknowns before the part with its first ones, and of its last ones with the first ones
        after it, (band, band).

    """

    frames: slice
    components: list[Index]
    differences: list[tuple[slice, Index]]
    bands: Array
    before: Array
    after: Array


class EquationLayout:
    """Positions of all unknowns in the banded equations of n frames and K lines.

    The equations are the augmented ones, [A, P'; P, -1] [u; s] = [W y; p], with the weighted differences P and their
    expected values p. Their condition number is the square root of that of A + P'P, which is large for a low cut-off.
    The unknowns of one frame are adjacent.
    """

    def __init__(self, n: int, lines: int, has_sensor: bool, has_colour: bool) -> None:
        self.n, self.k = n, lines
        # Components and order of each difference.
        self.terms: list[tuple[tuple[int, ...], int]] = [((0,), TREND_ORDER), *[((k,), 2) for k in range(1, lines + 1)]]
        if has_colour:
            self.terms.append(((lines + 1,), 1))
        if has_sensor:
            self.terms.append((tuple(range(lines + 1)), 2))
        n_components = 1 + lines + has_colour  # components of the positions
        keys = [np.arange(n) + 0.01 * k for k in range(n_components)]
        keys += [np.arange(n - d) + d / 2 + 0.3 + 0.01 * k for k, (_, d) in enumerate(self.terms)]
        order = np.argsort(np.concatenate(keys), kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        found = np.split(place, np.cumsum([len(k) for k in keys])[:-1])
        self.components, self.multiplier = found[:n_components], found[n_components:]
        self.size, self.group = len(order), n_components + len(self.terms)
        steps = [
            int(np.abs(m - self.components[k][i : len(m) + i]).max())
            for (components, d), m in zip(self.terms, self.multiplier, strict=True)
            for k in components
            for i in range(d + 1)
        ]
        self.band = max([*steps, n_components - 1])
        rows, columns = np.meshgrid(np.arange(n_components), np.arange(n_components), indexing="ij")
        self._of_weights = self._place(np.array(self.components)[rows], np.array(self.components)[columns])
        self._of_terms = [self._places_of_term(*term) for term in zip(self.terms, self.multiplier, strict=True)]
        self._of_multipliers = self._place(m := np.concatenate(self.multiplier), m)

    def _place(self, row: Index, column: Index) -> Index:
        """Positions of matrix elements in band storage, column after column."""
        return (3 * self.band + 1) * column + 2 * self.band + row - column

    def _places_of_term(self, term: tuple[tuple[int, ...], int], m: Index) -> Index:
        """Positions of the coefficients of one difference in rows and in columns, (2, components, order + 1, m)."""
        components, order = term
        x = np.array([[self.components[k][i : len(m) + i] for i in range(order + 1)] for k in components])
        rows = np.broadcast_to(m, x.shape)
        return np.array([self._place(rows, x), self._place(x, rows)])

    def block(self, size: int) -> int:
        """Unknowns per block of `size`; the last block must not be short, or trend and line would be degenerate."""
        sizes = range(BLOCK_FRAMES * self.group, 2 * BLOCK_FRAMES * self.group)
        return next(b for b in sizes if size % b == 0 or size % b >= b // 2)

    def equations(self, data: SmootherData, w: Array, lam: Array, lines: LineParameters) -> Array:
        """Equations in LAPACK band storage (3 band + 1, size) for weights w (n,); the top rows are for fill-in."""
        colour = data.colour
        flat = np.zeros((3 * self.band + 1) * self.size)
        flat[self._of_multipliers] = -1.0
        flat[self._of_weights] = w
        if colour:
            first = self.components[-1][:1]
            flat[self._place(first, first)] += 1.0 / colour.share
        for places, (strength, difference) in zip(self._of_terms, _differences(data, lam, lines), strict=True):
            flat[places] = difference[:, None] * strength
        return flat.reshape((3 * self.band + 1, self.size), order="F")

    def part(self, bands: Array, first: int, stop: int, begin: int) -> EquationPart:
        """Cut the equations of frames first to stop (exclusive) out of all; frame 0 is frame `begin` of the record."""
        low = int(self.components[0][first]) if first else 0
        high = int(self.components[0][stop]) if stop < self.n else self.size
        rows = [np.searchsorted(m, [low, high]).tolist() for m in self.multiplier]
        return EquationPart(
            slice(begin + first, begin + stop),
            [c[first:stop] - low for c in self.components],
            [(slice(begin + i, begin + j), m[i:j] - low) for (i, j), m in zip(rows, self.multiplier, strict=True)],
            bands[:, low:high],
            self._coupling(bands, low),
            self._coupling(bands, high),
        )

    def _coupling(self, bands: Array, place: int) -> Array:
        """Coefficients of the last unknowns before a place with the first ones from there on, (band, band)."""
        b = self.band
        out = np.zeros((b, b))
        if 0 < place < self.size:
            row, column = np.tril_indices(b)
            out[row, column] = bands[b + row - column, place + column]
        return out


def _differences(data: SmootherData, lam: Array, lines: LineParameters) -> Iterator[tuple[Array | float, Array]]:
    """Yield the strength of each difference and its coefficients."""
    yield np.sqrt(lam), FOURTH_DIFFERENCE
    for omega, mu in zip(lines.omega, lines.mu, strict=True):
        yield np.sqrt(mu), np.array([1.0, -2.0 * np.cos(omega), 1.0])
    if data.colour:
        yield data.colour.shocks**-0.5, np.array([-data.colour.correlation, 1.0])
    if data.second_difference_weights is not None:
        yield np.sqrt(data.second_difference_weights), SECOND_DIFFERENCE


@lru_cache(maxsize=64)
def equation_layout(n: int, lines: int, has_sensor: bool, has_colour: bool) -> EquationLayout:
    """Layout for n frames, cached."""
    return EquationLayout(n, lines, has_sensor, has_colour)


@dataclass(frozen=True, eq=False)
class FactoredPart(EquationPart):
    """A part whose bands are factors, with their pivots (size,); all parts before it were eliminated."""

    pivots: NDArray[np.int32]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.bands.shape[1]

    @property
    def logdet(self) -> float:
        """Log of the absolute determinant."""
        return float(np.sum(np.log(np.abs(self.bands[2 * len(self.after)]))))

    def solve(self, right: Array, carried: Array | float, following: Array | float = 0.0) -> Array:
        """Solve for the unknowns of this part."""
        band = len(self.after)
        right[:band] -= carried
        right[-band:] -= following
        return np.asarray(scipy.linalg.lapack.dgbtrs(self.bands, band, band, right, self.pivots, overwrite_b=1)[0])

    def carry(self, solution: Array) -> Array:
        """What eliminating this part subtracts from the right-hand side of the part after it, (band, ...)."""
        return np.asarray(self.after.T @ solution[-len(self.after) :])


def factor_part(part: EquationPart, corner: Array | None) -> FactoredPart:
    """Factor a part, after `corner` (band, band) of the parts before it was added; its bands are overwritten."""
    band = len(part.after)
    add_corners(part, corner)
    bands, pivots, _ = scipy.linalg.lapack.dgbtrf(part.bands, band, band, overwrite_ab=1)
    return FactoredPart(**{**vars(part), "bands": bands}, pivots=pivots)


def following_corner(part: FactoredPart) -> Array:
    """Correction of the first equations after a part, by eliminating it, (band, band)."""
    band, tail = len(part.after), min(2 * len(part.after), part.size)
    right = np.zeros((tail, band))
    right[-band:] = part.after
    # steps before the tail change nothing: they exchange a row with one at most `band` below, and both are zero
    pivots = part.pivots[-tail:] - (part.size - tail)
    found = scipy.linalg.lapack.dgbtrs(part.bands[:, -tail:], band, band, right, pivots)[0]
    return np.asarray(-part.after.T @ found[-band:])


def add_corners(part: EquationPart, first: Array | None, last: Array | None = None) -> None:
    """Add coefficients (band, band) to the first and to the last equations of a part."""
    band, size = len(part.after), part.bands.shape[1]
    for corner, place in ((first, 0), (last, size - band)):
        if corner is not None:
            row, column = np.indices((band, band))
            part.bands[2 * band + row - column, place + column] += corner


def reversed_part(part: EquationPart) -> EquationPart:
    """The same equations from the last unknown to the first one."""
    band = len(part.after)
    bands = np.zeros(part.bands.shape, order="F")
    bands[band:] = part.bands[band:][::-1, ::-1]
    return replace(part, bands=bands, before=part.after.T[::-1, ::-1], after=part.before.T[::-1, ::-1])


PAIRS_AT_ONCE = 64  # pairs of blocks solved in one call


class BlockEquations:
    """F parts of one size in blocks of unknowns, of which the last one is padded."""

    def __init__(self, parts: Sequence[EquationPart], layout: EquationLayout) -> None:
        size, self.band = parts[0].bands.shape[1], layout.band
        self.block = layout.block(size)
        self.many = max(-(-size // self.block), 2)
        self.padded = np.zeros((len(parts), 2 * self.band + 1, self.many * self.block))
        self.padded[:, self.band] = 1.0
        for own, part in zip(self.padded, parts, strict=True):
            own[:, :size] = part.bands[self.band :]
        self.before, self.after = self._corners()

    def _corners(self) -> tuple[Array, Array]:
        """Contributions of all blocks before and after each pair to its corners, two (F, pairs, band, band)."""
        b, pairs, f = self.band, self.many - 1, len(self.padded)
        before, after = np.zeros((2, f, pairs, b, b))
        known = np.zeros((2 * f, self.block, b))
        # equations within a block, and of the first unknowns of a block with the last ones before it, block by block:
        # those of all blocks would take far more memory
        row, column = np.indices((self.block, self.block))
        inside, place = np.abs(row - column) <= b, np.clip(b + row - column, 0, 2 * b)
        near, far = row[:b, :b] <= column[:b, :b], np.minimum(2 * b + row - column, 2 * b)[:b, :b]
        for k in range(1, pairs):
            blocks = (self.padded[:, place, self.block * i + column] for i in (k - 1, self.many - k))
            both = np.concatenate([np.where(inside, one, 0.0) for one in blocks])
            both[:f, :b, :b] += before[:, k - 1]
            both[f:, -b:, -b:] += after[:, pairs - k]
            ends = (self.block * i - b + column[:b, :b] for i in (k, pairs - k + 1))
            up, down = (np.where(near, self.padded[:, far, end], 0.0) for end in ends)
            known[:f, -b:], known[f:, :b] = up.swapaxes(1, 2), down
            found = _solve_symmetric(both, known)
            before[:, k] = -up @ found[:f, -b:]
            after[:, pairs - k - 1] = -down.swapaxes(1, 2) @ found[f:, :b]
        return before, after

    def variances(self, own: slice, place: Index, weights: Array) -> Array:
        """Compute variances of linear combinations of unknowns that lie at most one block apart.

        References
        ----------
        Takahashi, Fagan & Chen 1973, 8th PICA Conference Proc.

        """
        window = np.minimum(place.min(axis=1) // self.block, self.many - 2)
        slot = np.arange(len(place)) - np.searchsorted(window, window)
        inside = place - window[:, None] * self.block
        out = np.empty((len(self.padded[own]), *weights.shape[:2]))
        kinds = np.arange(len(weights))[:, None, None]
        for first in range(0, self.many - 1, PAIRS_AT_ONCE):
            stop = min(first + PAIRS_AT_ONCE, self.many - 1)
            rows = slice(*np.searchsorted(window, [first, stop]))
            at = (window[rows, None] - first, inside[rows], slot[rows, None] * len(weights) + kinds)
            right = np.zeros((stop - first, 2 * self.block, (int(np.max(slot[rows], initial=0)) + 1) * len(weights)))
            right[at] = weights[:, rows]
            found = self._solutions(own, first, stop, right)
            out[:, :, rows] = np.sum(found[:, *at] * weights[:, rows], axis=-1)
        return out

    def _solutions(self, own: slice, first: int, stop: int, right: Array) -> Array:
        """Solutions (F, W, 2 block, columns) of W pairs first to stop (exclusive), for right-hand sides (W, ...)."""
        b, wide = self.band, 2 * self.block
        column = self.block * np.arange(first, stop)[:, None] + np.arange(wide)
        row = np.arange(wide) + np.arange(-b, b + 1)[:, None]
        bands = np.where(((row >= 0) & (row < wide))[:, None], self.padded[own][:, :, column], 0.0)
        i, j = np.indices((b, b))
        bands[:, b + i - j, :, j] += np.moveaxis(self.before[own, first:stop], 1, -1).transpose(1, 2, 0, 3)
        bands[:, b + i - j, :, wide - b + j] += np.moveaxis(self.after[own, first:stop], 1, -1).transpose(1, 2, 0, 3)
        out = np.empty((len(bands), *right.shape))
        for one, found in zip(bands.reshape(len(bands), 2 * b + 1, -1), out, strict=True):
            equations = np.zeros((3 * b + 1, one.shape[1]), order="F")  # as LAPACK takes them, without another copy
            equations[b:] = one
            solved = scipy.linalg.lapack.dgbsv(b, b, equations, right.reshape(-1, right.shape[-1]), overwrite_ab=1)
            found[:] = solved[2].reshape(right.shape)
        return out


def _solve_symmetric(a: Array, right: Array) -> Array:
    """Solutions of symmetric equations (..., n, n); frames without weight may make them singular."""
    try:
        return np.asarray(np.linalg.solve(a, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(a, hermitian=True) @ right)
