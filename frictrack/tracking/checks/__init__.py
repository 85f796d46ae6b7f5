"""Check a track by itself: time base, motion, interlacing, peak locking, scores, both directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import shift
from scipy.signal import savgol_filter

from frictrack.base.distributions import chi2_isf, chi2_sf, normal_ppf, robust_std
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track, stretches
from frictrack.sampling import SampledPath, Slip, count_text, describe_frames, find_slips, frame_numbers
from frictrack.tracking.template_learning import pixel_harmonics

MIN_JUMP_PX = 0.1  # errors of the tracker may be as large
MIN_SIGMA_PX = 1e-4  # no track is more accurate


def slips(track: Track) -> tuple[Slip, ...]:
    """Find doubled and missing frames of a track.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    tuple of Slip
        In order; empty where the target is too slow.

    """
    return find_slips(_main_direction(track))


def timing_note(found: Sequence[Slip]) -> tuple[str, ...]:
    """Describe doubled and missing frames.

    Parameters
    ----------
    found : sequence of Slip
        Faults of the time base.

    Returns
    -------
    tuple of str
        At most one note on doubled and one on missing frames.

    """
    doubled = [s.frame for s in found if s.doubled]
    missing = [s.frame for s in found if not s.doubled]
    lost = sum(s.frames for s in found if not s.doubled)
    kinds = (
        (len(doubled), "doubled", describe_frames(doubled)),
        (lost, "missing", f"before {describe_frames(missing)}"),
    )
    return tuple(
        f"{count_text(count, 'frame is', 'frames are')} {what}, found from the motion: {where}"
        for count, what, where in kinds
        if count
    )


def _main_direction(track: Track) -> SampledPath:
    """The track along the line on which it moves most."""
    found = track.found & np.isfinite(track.y_px) & np.isfinite(track.sigma_px)
    at = np.stack([track.x_px, track.y_px], axis=1)
    if not found.any():
        return SampledPath(at[:, 0], at[:, 0], np.arange(len(at)), found, MIN_JUMP_PX)
    _, _, axes = np.linalg.svd(at[found] - at[found].mean(axis=0), full_matrices=False)
    sigma = np.hypot(axes[0, 0] * track.sigma_px, axes[0, 1] * track.sigma_y_px)
    ticks = frame_numbers(track.t).astype(np.int64)
    return SampledPath(at @ axes[0], np.maximum(sigma, MIN_SIGMA_PX), ticks, found, MIN_JUMP_PX)


SMOOTHING_FRAMES = 15  # window of the local cubic about which residuals are taken
MIN_TRAVEL_PX = 2.0  # over less, motion and periodic errors cannot be separated
N_HARMONICS = 2  # of one cycle per pixel, `pixel_harmonics`
ALPHA_PEAK_LOCKING = 1e-3  # significance level of peak locking
MIN_AMPLITUDE_SIGMAS = 0.2  # standard deviations of a frame, from which the amplitude is reported
LOW_SCORE_MARGIN = 0.1  # below the typical score, from which a score is low


@dataclass(frozen=True, eq=False)
class PeakLocking:
    """Position error that repeats from pixel to pixel.

    Attributes
    ----------
    amplitude, error : float
        Half of its range and the standard deviation, px.
    p : float
        Probability of such an amplitude from noise alone.
    frequency : float
        Frequency at the typical speed, as sampled by the camera, Hz.
    acceleration : float
        Apparent acceleration A (2 pi f)^2, px/s^2.

    """

    amplitude: float
    error: float
    p: float
    frequency: float
    acceleration: float


def peak_locking(track: Track) -> PeakLocking | None:
    """Estimate peak locking: the part of the residuals about a smooth curve that repeats from pixel to pixel.

    Residuals and harmonics pass the same smoother. Its attenuation cancels, and a slow target costs precision but gives
    no
    bias.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    PeakLocking or None
        None for a target that travels less than `MIN_TRAVEL_PX`, or with too few frames.

    """
    parts = _long_stretches(track.found)
    x, t = track.x_px, track.t
    if not parts or np.ptp(x[track.found]) < MIN_TRAVEL_PX:
        return None
    residual = np.concatenate([_detrend(x[part]) for part in parts])
    harmonics = np.concatenate([_detrend(pixel_harmonics(x[part])) for part in parts])
    sigma = np.concatenate([track.sigma_px[part] for part in parts])
    keep = np.isfinite(sigma) & (np.abs(residual) < 6 * robust_std(residual) + 1e-12)
    design, value = harmonics[keep] / sigma[keep, None], residual[keep] / sigma[keep]
    power, axes = np.linalg.eigh(design.T @ design)
    if len(value) < 40 or power[0] < 1e-6 * len(value) / np.median(sigma) ** 2:
        return None
    inverse = (axes / power) @ axes.T
    curve = inverse @ (design.T @ value)
    dof = len(value) * (1 - 4 / SMOOTHING_FRAMES) - 2 * N_HARMONICS
    noise = float(np.sum((value - design @ curve) ** 2)) / dof
    covariance = inverse * noise
    strength = float(curve @ np.linalg.solve(covariance, curve))
    pixel = pixel_harmonics(np.linspace(0, 1, 200))
    error = float(np.sqrt(np.mean(np.einsum("ij,jk,ik->i", pixel, covariance, pixel))))
    speed = float(np.median(np.abs(np.concatenate([np.gradient(x[part], t[part]) for part in parts]))))
    rate = 1 / float(np.median(np.diff(t)))
    frequency = abs(speed - rate * round(speed / rate))
    amplitude = float(np.ptp(pixel @ curve)) / 2
    acceleration = amplitude * (2 * np.pi * frequency) ** 2
    return PeakLocking(amplitude, error, float(chi2_sf(strength, 2 * N_HARMONICS)), frequency, acceleration)


def _long_stretches(found: Mask) -> list[slice]:
    """Unbroken stretches of found frames that are long enough for smoothing."""
    return [s for s in stretches(found) if s.stop - s.start >= 2 * SMOOTHING_FRAMES]


def _detrend(values: Array) -> Array:
    """Residuals about a local cubic along the first axis, in full windows at the ends."""
    return np.asarray(values - savgol_filter(values, SMOOTHING_FRAMES, 3, axis=0, mode="interp"))


@dataclass(frozen=True)
class Scores:
    """Match scores of a track: typical and lowest value, and stretches (first, last frame) of low scores."""

    median: float
    lowest: float
    low: tuple[tuple[int, int], ...]


def scores(track: Track) -> Scores | None:
    """Summarise the match scores of a track.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    Scores or None
        None for a track without scores.

    """
    known = np.isfinite(track.score) & track.found
    if not known.any():
        return None
    score = np.where(known, track.score, np.nan)
    usual = float(np.nanmedian(score))
    spread = float(robust_std(score[np.isfinite(score)] - usual))
    low = known & (np.nan_to_num(score, nan=1.0) < usual - max(LOW_SCORE_MARGIN, 6 * spread))
    return Scores(usual, float(np.nanmin(score)), tuple((s.start, s.stop - 1) for s in stretches(low)))


@dataclass(frozen=True)
class ForwardBackward:
    """Comparison of tracking in both directions.

    Attributes
    ----------
    rms : float
        Rms difference of the positions, px.
    in_sigma : float
        The same in standard deviations.
    only_one : int
        Number of frames found in one direction only.

    """

    rms: float
    in_sigma: float
    only_one: int

    @property
    def summary(self) -> str:
        """The comparison in one sentence."""
        difference = (
            f"tracked backward, positions differ by {self.rms:.2g} px rms ({self.in_sigma:.2g} standard deviations)"
        )
        lost = f"; {self.only_one} frames are found in one direction only" if self.only_one else ""
        doubt = ": they depend on the direction of tracking" if self.in_sigma > 0.5 else ""
        return difference + lost + doubt


def forward_backward(forward: Track, backward: Track) -> ForwardBackward:
    """Compare a track with that of the film played backward.

    Parameters
    ----------
    forward, backward : Track
        Both with their rows in the order of the film.

    Returns
    -------
    ForwardBackward
        Rms is NaN where no frame is found in both.

    """
    both = forward.found & backward.found
    only_one = int(np.count_nonzero(forward.found ^ backward.found))
    if not both.any():
        return ForwardBackward(float("nan"), float("nan"), only_one)
    off = np.stack([forward.x_px - backward.x_px, forward.y_px - backward.y_px], axis=1)[both]
    sigma = np.stack([forward.sigma_px, forward.sigma_y_px], axis=1)[both]
    return ForwardBackward(
        float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(np.sqrt(np.mean((off / sigma) ** 2))), only_one
    )


def self_test(track: Track) -> tuple[str, ...]:
    """Test a track for peak locking and low match scores.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    tuple of str
        Notes on what matters.

    """
    return (*_locking_note(peak_locking(track), track), *_score_note(scores(track)))


def _locking_note(locking: PeakLocking | None, track: Track) -> tuple[str, ...]:
    if (
        locking is None
        or locking.p > ALPHA_PEAK_LOCKING
        or locking.amplitude < MIN_AMPLITUDE_SIGMAS * float(np.nanmedian(track.sigma_px))
    ):
        return ()
    return (
        f"peak locking of {locking.amplitude:.4f} +/- {locking.error:.4f} px: positions repeat an error from pixel to "
        f"pixel, at the typical speed an oscillation of {locking.frequency:.0f} Hz and "
        f"{locking.acceleration:.3g} px/s^2",
    )


def _score_note(history: Scores | None) -> tuple[str, ...]:
    if history is None or not history.low:
        return ()
    listed = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in history.low[:6])
    more = f" and {len(history.low) - 6} more stretches" if len(history.low) > 6 else ""
    return (f"match score low (usually {history.median:.2f}, down to {history.lowest:.2f}) in frames {listed}{more}",)


ALPHA = 1e-3  # significance level of motion
SMOOTH_FRAMES = 16  # from this number on, the steps of a smooth path can be distinguished from those of noise


def at_rest(track: Track) -> tuple[str, ...]:
    """Note that a target does not move by more than its noise.

    Parameters
    ----------
    track : Track
        Track of the target.

    Returns
    -------
    tuple of str
        Empty for a target that moves.

    """
    found = _compared(track)
    if _moves(_places(track)[:, found], _sigma(track)[:, found]):
        return ()
    noise = float(np.sqrt(np.median(np.mean(_sigma(track)[:, found] ** 2, axis=0))))
    return (
        f"the target does not move by more than the noise of its places, {noise:.2g} px; if something else in the "
        "picture moves, give its rectangle as target = [x, y, w, h], else film it closer",
    )


def moves_with(track: Track, reference: Track) -> bool:
    """Test whether a target moves, but not relative to a reference: then the reference moves as well.

    Parameters
    ----------
    track, reference : Track
        Tracks of the same film.

    Returns
    -------
    bool
        True where the reference moves like the target.

    """
    found = _compared(track) & _compared(reference)
    if np.count_nonzero(found) < SMOOTH_FRAMES:
        return False
    own, other = _places(track)[:, found], _places(reference)[:, found]
    sigma = _sigma(track)[:, found]
    return _moves(own, sigma) and not _moves(own - other, np.hypot(sigma, _sigma(reference)[:, found]))


def _compared(track: Track) -> Mask:
    """Frames (n,) that were compared with another frame than themselves."""
    return np.asarray(track.found & (np.arange(len(track)) != track.template))


def _places(track: Track) -> Array:
    return np.stack([track.x_px, track.y_px])


def _sigma(track: Track) -> Array:
    return np.stack([track.sigma_px, track.sigma_y_px])


def _moves(places: Array, sigma: Array) -> bool:
    """Whether positions (2, n) scatter by more than their noise, or more smoothly than noise would.

    The ratio of squared steps to squares is 2 for noise, with a variance of 4 / n (von Neumann 1941, Ann. Math. Stat.
    12:367).
    """
    n, off = places.shape[1], places - places.mean(axis=1, keepdims=True)
    if float(np.sum((off / sigma) ** 2)) > chi2_isf(ALPHA, 2 * (n - 1)):
        return True
    ratio = np.sum(np.diff(off, axis=1) ** 2, axis=1) / np.maximum(np.sum(off**2, axis=1), 1e-300)
    return bool(n >= SMOOTH_FRAMES and float(np.min(ratio)) < 2 + normal_ppf(ALPHA / 2) * 2 / np.sqrt(n))


FRAMES = 24  # that are looked at, those in which the target is fastest
MIN_STEP_PX = 0.5  # of the target from frame to frame; slower ones show nothing
MAX_MISFIT_SHARE = 0.6  # of lines that are moved by half a step, over that of lines as they are


def interlacing_note(film: Recording, track: Track) -> tuple[str, ...]:
    """Note that the lines of a film were exposed at two moments.

    Parameters
    ----------
    film : Recording
        The film, with random access.
    track : Track
        Track of the target.

    Returns
    -------
    tuple of str
        Empty for a progressive film, and where the target is too slow to tell.

    """
    assert track.target is not None
    width, height = (int(side) for side in track.target[2:])
    step = np.nan_to_num(np.gradient(track.x_px)) * track.found
    fastest = np.sort(np.argsort(-np.abs(step))[:FRAMES])
    fastest = fastest[(np.abs(step[fastest]) > MIN_STEP_PX) & (np.abs(step[fastest]) < width / 2)]
    if not len(fastest):
        return ()
    corners = np.stack([track.x_px - (width - 1) / 2, track.y_px - (height - 1) / 2], axis=1)[fastest]
    corners = np.clip(np.rint(corners).astype(int), 0, np.array(film.shape)[::-1] - (width, height))
    pictures = film.cut(fastest, corners, (height, width)).astype(float)
    shares = [_misfit_shares(*each) for each in zip(pictures, step[fastest] / 2, corners[:, 1], strict=True)]
    if min(np.median(shares, axis=0)) > MAX_MISFIT_SHARE:
        return ()
    return (
        "the film is interlaced: odd and even lines show the target at two moments, half a frame apart; film "
        "progressively, or separate the fields, as with ffmpeg -vf bwdif=send_field",
    )


def _misfit_shares(picture: Array, moved: float, top: int) -> tuple[float, float]:
    """Misfit of the odd lines to their neighbours once moved by so many px, to either side, over that unmoved."""
    first = 1 + top % 2  # the first odd line of the film with a line above it
    odd = picture[first:-1:2]
    between = (picture[first - 1 : -2 : 2][: len(odd)] + picture[first + 1 :: 2][: len(odd)]) / 2
    edge = int(np.ceil(abs(moved))) + 1
    left = [(shift(odd, (0, by), order=3, mode="nearest") - between)[:, edge:-edge] for by in (0.0, moved, -moved)]
    still, right, wrong = (float(np.sum(part**2)) for part in left)
    return right / max(still, 1e-300), wrong / max(still, 1e-300)
