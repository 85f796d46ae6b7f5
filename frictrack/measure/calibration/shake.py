"""Estimate camera shake from the track of a fixed object, and subtract it.

Subtracting the measured reference would add its noise to every frame of the target. Its motion is therefore decomposed:
steady tones are fitted, and the remainder is filtered in the spectrum (Wiener 1949: power less noise over power). What
does not exceed the white noise is zero, so that a camera at rest costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from frictrack.base.distributions import chi2_isf
from frictrack.base.errors import FrictrackError
from frictrack.records import Array, Mask, Track

ALPHA_SHAKE = 1e-3  # probability that noise alone is taken for shake, over all frequencies of an axis
MIN_SHAKE_SIGMAS = 5.0  # times its own uncertainty that shake must be before it is subtracted
N_SMOOTHED = 5  # frequencies over which the spectrum is smoothed; each has one degree of freedom (real cosines)
MIN_FRAMES = 32  # in which the reference must be found
MAX_TONES = 6  # steady tones fitted along each axis
MAX_ROUNDS = 8  # of Gauss-Newton on their frequencies


@dataclass(frozen=True, eq=False)
class Shake:
    """Motion of the picture beyond its measurement noise.

    Attributes
    ----------
    movement : array (n, 2)
        Shake in every frame, px.
    sigma, size : array (2,)
        Standard deviation and rms of the movement, px.
    floor : array (2,)
        Rms of the reference without it, px: the noise floor.
    frequency : float or None
        Where it is strongest, Hz; None without shake.
    left_in : float
        Rms of shake that is too small to be subtracted, px.

    """

    movement: Array
    sigma: Array
    size: Array
    floor: Array
    frequency: float | None
    left_in: float = 0.0  # px

    @property
    def detected(self) -> bool:
        """Whether shake was detected."""
        return self.frequency is not None


def estimate_shake(reference: Track, min_rms: float = 0.0) -> Shake:
    """Estimate camera shake from the track of a fixed object.

    On each axis the noise is white, at the level of the upper half of the spectrum. Tones count where noise alone would
    make such a tone in one of a thousand films. In the remainder those frequencies count whose mean power over five
    neighbours exceeds what noise alone reaches (cosine transform: a drift leaks little). Lost frames are interpolated.

    Parameters
    ----------
    reference : Track
        Track of the fixed object.
    min_rms : float
        Smaller shake is ignored and reported as `left_in`, px.

    Returns
    -------
    Shake
        Zero movement where no shake is detected.

    Raises
    ------
    FrictrackError
        For a reference that is found in no frame.

    """
    if not np.any(reference.found):
        raise FrictrackError(f'the reference "{reference.name}" was found in no frame; choose another one')
    at = _interpolate_lost(np.stack([reference.x_px, reference.y_px], axis=1), reference.found)
    at = at - at.mean(axis=0)
    stated_sigma = [float(np.nanmedian(s)) for s in (reference.sigma_px, reference.sigma_y_px)]
    movement, variance, left_in = np.zeros(at.shape), np.zeros(2), 0.0
    if np.count_nonzero(reference.found) >= MIN_FRAMES:
        for axis in range(2):
            motion, error = significant_motion(at[:, axis], reference.t, stated_sigma[axis])
            if np.std(motion) >= min_rms:
                movement[:, axis], variance[axis] = motion, error
            else:
                left_in = max(left_in, float(np.std(motion)))
    return Shake(
        movement,
        sigma=np.sqrt(variance),
        size=np.std(movement, axis=0),
        floor=np.sqrt(np.mean((at - movement)[reference.found] ** 2, axis=0)),
        frequency=_strongest(movement, reference.t) if np.any(variance) else None,
        left_in=left_in,
    )


def subtract_shake(track: Track, reference: Track | None, min_rms: float = 0.0) -> tuple[Track, tuple[str, ...]]:
    """Subtract camera shake from a track.

    Parameters
    ----------
    track : Track
        Track of the target.
    reference : Track or None
        Track of a fixed object in the same film; None leaves the track unchanged.
    min_rms : float
        Smaller shake is left in, px.

    Returns
    -------
    track : Track
        With the uncertainty of the reference added to sigma. Where shake is subtracted and the reference was lost, the
        position is NaN.
    notes : tuple of str
        What was done.

    Raises
    ------
    FrictrackError
        Where the two tracks have different lengths.

    """
    if reference is None:
        return track, ()
    if len(reference) != len(track):
        raise FrictrackError(f"expected a reference track of {len(track)} frames but got {len(reference)}")
    found = estimate_shake(reference, min_rms)
    if not found.detected:
        return track, (*reference.notes, _nothing_subtracted(reference, found))
    nan_where_lost = np.where(reference.found, 0.0, np.nan)
    corrected = replace(
        track,
        x_px=track.x_px - found.movement[:, 0] + nan_where_lost,
        y_px=track.y_px - found.movement[:, 1] + nan_where_lost,
        angle=track.angle + nan_where_lost,
        sigma_angle=None if track.sigma_angle is None else track.sigma_angle + nan_where_lost,
        sigma_px=np.hypot(track.sigma_px, found.sigma[0]) + nan_where_lost,
        sigma_y_px=np.hypot(track.sigma_y_px, found.sigma[1]) + nan_where_lost,
        reason=np.where(track.found & ~reference.found, "the reference is lost", track.reason),
    )
    return corrected, (*reference.notes, _subtracted(reference, found))


def _interpolate_lost(at: Array, found: Mask) -> Array:
    """Positions (n, 2) with lost frames interpolated."""
    n = np.arange(len(at))
    return np.stack([np.interp(n, n[found], column[found]) for column in at.T], axis=1)


def significant_motion(x: Array, t: Array, stated_sigma: float = 0.0) -> tuple[Array, float]:
    """Extract from a series what exceeds its white noise.

    Parameters
    ----------
    x : array (n,)
        Series with mean zero.
    t : array (n,)
        Times, s.
    stated_sigma : float
        Standard deviation that the measurement states; the noise is at least a quarter of its square.

    Returns
    -------
    motion : array (n,)
        Zero where nothing is significant.
    variance : float
        Variance of this motion.

    """
    window = np.hanning(len(x))
    power = np.abs(np.fft.rfft(x * window)) ** 2
    upper_half = float(np.median(power[len(power) // 2 :]) / np.log(2) / np.sum(window**2))
    noise = max(upper_half, 0.25 * stated_sigma**2, 1e-20)
    tones, count = _tones(x, (t - t.mean()) / np.median(np.diff(t)), noise)
    spectrum = scipy.fft.dct(x - tones, norm="ortho")
    gain = _wiener_gain(spectrum**2, noise)
    movement = tones + scipy.fft.idct(gain * spectrum, norm="ortho")
    variance = noise * (float(gain.mean()) + 3 * count / len(x))
    # Partly subtracted shake would no longer be a tone, which later steps could detect.
    is_known = float(np.std(movement)) > MIN_SHAKE_SIGMAS * np.sqrt(variance)
    return (movement, variance) if is_known else (np.zeros(len(x)), 0.0)


def _tones(x: Array, time: Array, noise: float) -> tuple[Array, int]:
    """Sum of the steady tones in x (n,) and their number; all are fitted again with each new one.

    `time` (n,) is in frames, with gaps where frames are missing.
    """
    n, model = len(x), np.zeros(len(x))
    # chi^2 of amplitude and phase at the best of n frequencies, fitted besides
    min_rms = 2 * np.log(n / ALPHA_SHAKE) + 10
    found: list[float] = []
    while len(found) < MAX_TONES:
        power = np.abs(np.fft.rfft((x - model) * np.hanning(n), 4 * n))
        power[:6] = 0.0  # less than one and a half periods in the film is no tone but a drift
        fitted, frequencies = _fit_tones(x, time, np.array([*found, float(np.argmax(power)) / (4 * n)]))
        if float(np.sum((x - model) ** 2) - np.sum((x - fitted) ** 2)) < min_rms * noise:
            break
        model, found = fitted, frequencies.tolist()
    return model - model.mean(), len(found)


def _fit_tones(x: Array, time: Array, cycles: Array) -> tuple[Array, Array]:
    """Fit tones to x (n,) from initial frequencies (k,) in cycles per frame: their sum and the frequencies."""
    k, model = len(cycles), np.zeros(len(x))
    for _ in range(MAX_ROUNDS):
        turn = 2 * np.pi * time[:, None] * cycles
        waves = np.concatenate([np.ones((len(x), 1)), np.cos(turn), np.sin(turn)], axis=1)
        size = np.linalg.lstsq(waves, x, rcond=1e-9)[0]
        model = waves @ size
        a, b = size[1 : k + 1], size[k + 1 :]
        slope = 2 * np.pi * time[:, None] * (b * np.cos(turn) - a * np.sin(turn))
        step = np.linalg.lstsq(np.concatenate([waves, slope], axis=1), x - model, rcond=1e-9)[0][-k:]
        cycles = np.clip(cycles + np.clip(step, -0.25 / len(x), 0.25 / len(x)), 1 / len(x), 0.5 - 0.5 / len(x))
        if np.max(np.abs(step)) < 1e-4 / len(x):
            break
    return model, cycles


def _wiener_gain(power: Array, noise: float) -> Array:
    """Wiener gain of each cosine; zero where its neighbourhood does not exceed the noise."""
    smooth = scipy.ndimage.uniform_filter1d(power, N_SMOOTHED, mode="nearest")
    stands_out = smooth > noise * float(chi2_isf(ALPHA_SHAKE / len(power), N_SMOOTHED)) / N_SMOOTHED
    kept_band = scipy.ndimage.uniform_filter1d(stands_out.astype(np.float64), N_SMOOTHED, mode="nearest") > 0
    return np.where(kept_band, np.maximum(smooth - noise, 0.0) / np.maximum(smooth, 1e-300), 0.0)


def _strongest(movement: Array, t: Array) -> float:
    """Frequency at which the movement (n, 2) is largest, Hz."""
    n = len(movement)
    power = np.max(np.abs(np.fft.rfft(movement * np.hanning(n)[:, None], 16 * n, axis=0)), axis=1)
    return float(np.argmax(power)) / (16 * n * float(np.median(np.diff(t))))


def _nothing_subtracted(reference: Track, found: Shake) -> str:
    if np.count_nonzero(reference.found) < MIN_FRAMES:
        return (
            f"the fixed reference {_label(reference)} is seen in {np.count_nonzero(reference.found)} frames, which are "
            "too few to separate camera shake from noise; nothing is subtracted"
        )
    if found.left_in:
        x, y, w, h = (round(v) for v in reference.target or (0, 0, 0, 0))
        return (
            f"camera shake of {found.left_in:.2g} px (rms) is seen in the fixed reference {_label(reference)} and "
            f"left in: other films may not resolve so little; reference = [{x}, {y}, {w}, {h}] subtracts it"
        )
    x, y = found.floor
    return (
        f"no camera shake: the fixed reference {_label(reference)} moves by {x:.2g} px along x and {y:.2g} px along y "
        f"(rms), which does not significantly exceed its noise"
    )


def _subtracted(reference: Track, found: Shake) -> str:
    (x, y), sigma, floor = found.size, float(np.max(found.sigma)), float(np.max(found.floor))
    return (
        f"camera shake of {x:.2g} px along x and {y:.2g} px along y (rms), strongest at {found.frequency:.0f} Hz, is "
        f"seen in the fixed reference {_label(reference)} and subtracted; this adds {sigma:.2g} px of uncertainty, and "
        f'{floor:.2g} px of noise remain in the reference (reference = "none" leaves the shake in)'
    )


def _label(reference: Track) -> str:
    if reference.target is None:
        return f'"{reference.name}"'
    return "[" + ", ".join(f"{v:.0f}" for v in reference.target) + "]"
