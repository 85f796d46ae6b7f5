"""Test whether a sensor, or the energy of an impact, agrees with the camera, and name the likely cause if not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.measure.motion import KnownAcceleration
from frictrack.measure.sensors.alignment import (
    ALPHA_WHITENESS,
    LOWEST_BAND_SIZE,
    Alignment,
    AlignmentFit,
    AlignmentProblem,
    align,
    fit_alignment,
    whiteness_test,
)
from frictrack.measure.sensors.sensor_record import SensorRecord, Whitener
from frictrack.records import GRAVITY, Array

REPORT_SIGMAS = 3.0  # standard deviations from which a gain or a bias is reported
GAIN_TOLERANCE = 0.05  # relative error of a sensor's sensitivity that is common
MAX_GAIN_FACTOR = 1.3  # by which a sensitivity may be off; beyond it the sign, the unit or the sensor is another
MAX_OFFSET_SIGMAS = 4.0  # standard deviations by which a given offset may differ from the data's
MIN_CAUSE_SHARE = 0.5  # of the excess that one frequency, or one moment, must hold to be named as the cause
N_MOMENTS = 12  # parts of the record that are searched for a single moment of disagreement
N_WINDOWS = 24  # means in which the difference is quoted
GAIN_EXPLANATIONS = {
    -1.0: 'its axis points the other way: flip its sign with columns = {a = "-a (m/s^2)"}',
    GRAVITY: 'it is in units of gravity: say so with columns = {a = "a (g)"}',
    -GRAVITY: 'it is in units of gravity and its axis points the other way: columns = {a = "-a (g)"}',
    1e-3: 'it is in mm/s^2: say so with columns = {a = "a (mm/s^2)"}',
}  # gain -> what explains it
IMPOSSIBLE_SIGMAS = 3.0  # standard deviations above the stated energy that cannot be chance
SUSPICIOUS_SHARE = 0.1  # of the stated energy; less suggests a wrong scale, frame rate or mass


@dataclass(frozen=True)
class SensorComparison:
    """Comparison of camera and sensor.

    Attributes
    ----------
    verdict : str
        "consistent", "disagrees" or "not compared".
    says : tuple of str
        One sentence per finding, the cause of a disagreement first.
    p : float or None
        Probability of the worst octave of the difference, times the number of octaves.
    reduced_chi2 : float or None
        Of the whitened difference.
    rms_difference, rms_expected : float or None
        Rms difference of means over `window`, and the part that both noises explain, m/s^2.
    window : float or None
        Duration of a mean, s.

    """

    verdict: str
    says: tuple[str, ...] = ()
    p: float | None = None
    reduced_chi2: float | None = None
    rms_difference: float | None = None
    rms_expected: float | None = None
    window: float | None = None


def compare_with_camera(problem: AlignmentProblem, alignment: Alignment, scale_error: float = 0.0) -> SensorComparison:
    """Compare an aligned accelerometer with the camera.

    This is the only rule for its use. It is used ("consistent") if one offset alone is probable, its gain is that of a
    sensor in m/s^2 within a factor `MAX_GAIN_FACTOR`, its zero error is below gravity, and the difference is white.
    Gain and zero error are then taken out.

    `scale_error`: relative standard deviation of the camera's scale. Returns the verdict and findings.
    """
    if alignment.rivals:
        fixed = 'its clock is ambiguous: give the delay of your set-up, as in {table = "..", offset = "1.2 ms"}'
        return SensorComparison("not compared", (fixed,))
    if alignment.gain is None or alignment.sigma_gain is None:
        return SensorComparison("not compared", (f"not compared with the camera: {alignment.reason}",))
    free = alignment.sigma_offset is not None
    overlapping = problem.select(problem.rows(alignment))
    fitted = fit_alignment(overlapping, alignment, 1 + free + (free and alignment.sigma_rate is not None))
    p, excess = whiteness_test(fitted.regressors, fitted.residual)
    faults = [
        "" if free else _offset_fault(problem, alignment),
        _describe_misfit(overlapping, fitted, excess) if p < ALPHA_WHITENESS else "",
        _gain_fault(alignment.gain, alignment.sigma_gain, scale_error),
    ]
    bias, sigma = alignment.bias or 0.0, alignment.sigma_bias or 0.0
    if abs(bias) > GRAVITY + REPORT_SIGMAS * sigma:
        tilt = f"its zero is off by {bias:.3g} m/s^2, more than any tilt could do ({GRAVITY:.3g})"
        faults.append(f"{tilt}: zero it, or check its unit and the range of its amplifier")
    faults = list(filter(None, faults))
    difference, expected, window = _rms_difference(overlapping, alignment)
    return SensorComparison(
        verdict="disagrees" if faults else "consistent",
        says=(*faults, *_findings(problem.series, alignment, scale_error)),
        p=p,
        reduced_chi2=float(np.sum(fitted.residual**2)) / max(len(fitted.residual) - fitted.regressors.shape[1], 1),
        rms_difference=difference,
        rms_expected=expected,
        window=window,
    )


def known_acceleration(series: SensorRecord, alignment: Alignment, t: Array) -> KnownAcceleration:
    """Compute the acceleration that an aligned accelerometer measured at the camera's frames.

    Each value is a mean over one frame interval. A sensor slower than the camera repeats values over several frames;
    its
    noise is scaled such that the frames, taken as independent, have the right weight together.

    `series`: accelerometer, m/s^2; `alignment`: result of `align`, with gain and bias; `t` (n,): times of the frames,
    s. Returns the acceleration with its noise; NaN where the sensor was not running.
    """
    assert alignment.gain is not None
    assert alignment.bias is not None
    h = float(np.median(np.diff(t)))
    a = alignment.gain * series.average(t - alignment.lag(t), h) + alignment.bias
    return KnownAcceleration(a, abs(alignment.gain) * float(np.sqrt(series.density / h)))


def _gain_fault(gain: float, sigma: float, scale_error: float) -> str:
    """Report a gain that no sensitivity explains, with its likely cause; a smaller error is taken out."""
    spread = REPORT_SIGMAS * np.hypot(sigma, scale_error)
    if 1.0 / MAX_GAIN_FACTOR - spread <= gain <= MAX_GAIN_FACTOR + spread:
        return ""
    finding = f"its gain is {gain:.4g} +/- {sigma:.2g} instead of 1"
    if abs(gain) < REPORT_SIGMAS * sigma:
        return f"{finding}: it does not follow what the camera sees; check that it belongs to this run"
    for unit, why in GAIN_EXPLANATIONS.items():
        if abs(gain / unit - 1.0) < GAIN_TOLERANCE + REPORT_SIGMAS * sigma / abs(unit):
            return f"{finding}: {why}"
    frames = f", or the frame rate by {np.sqrt(gain):.4g}" if gain > 0 else ""
    return (
        f"{finding}: the scale is too large by this factor{frames}, or the sensor's sensitivity is off; "
        "check the scale and the frame rate first, forces go with both"
    )


def _offset_fault(problem: AlignmentProblem, alignment: Alignment) -> str:
    """Report a given offset that the data reject."""
    overlapping = problem.select(problem.rows(alignment))
    fitted = fit_alignment(overlapping, alignment)
    if fitted.theta[1] ** 2 < MAX_OFFSET_SIGMAS**2 * fitted.covariance[1, 1]:
        return ""
    better = align(problem)
    if better.sigma_offset is None:
        return ""
    found = f"{1e3 * better.offset:.4g} +/- {1e3 * better.sigma_offset:.2g} ms"
    return (
        f"the offset of {1e3 * alignment.offset:.4g} ms is wrong, the data give {found}: correct it, or estimate it "
        'with offset = "auto"'
    )


def _describe_misfit(problem: AlignmentProblem, fitted: AlignmentFit, excess: Array) -> str:
    """Describe the difference that both noises do not explain: one frequency, one moment, slow, or neither."""
    frames, n = problem.frames, len(excess)
    total = float(np.sum(excess))
    line = int(np.argmax(excess))
    frequency = line / (2.0 * n * frames.interval)
    line_power = float(np.sum(excess[max(line - 2, 0) : line + 3]))
    if line_power > MIN_CAUSE_SHARE * total > 0.0 and line >= LOWEST_BAND_SIZE:
        return (
            f"they differ by one sinusoid at {frequency:.3g} Hz: most likely its mounting (or its own resonance), "
            "or the tracked target shakes; fix both to the slider"
        )
    moments = np.array([np.sum(part**2 - 1.0) for part in np.array_split(fitted.residual, N_MOMENTS)])
    loudest = int(np.argmax(moments))
    if moments[loudest] > MIN_CAUSE_SHARE * float(np.sum(moments)) > 0.0:
        at = np.array_split(frames.t[frames.centre], N_MOMENTS)[loudest]
        return (
            f"they differ from {at[0]:.4g} s to {at[-1]:.4g} s: an impact beyond the sensor's range or bandwidth, "
            "a loose mounting, or a lost target; look at these frames"
        )
    if float(np.sum(excess[: 2 * LOWEST_BAND_SIZE])) > MIN_CAUSE_SHARE * total > 0.0:
        return (
            "they differ slowly: a sensor that drifts, does not measure down to 0 Hz, or tilts on its way; or a scale "
            "that changes along the course; check the sensor's lowest frequency"
        )
    return (
        "they differ by more than their noises explain, but at no single frequency or moment: the sensor measures more "
        "than the slider's motion along the course; check its axis and its mounting"
    )


def _findings(series: SensorRecord, alignment: Alignment, scale_error: float) -> list[str]:
    """Findings about a sensor that are no disagreement."""
    found = []
    gain, sigma, bias = alignment.gain or 1.0, alignment.sigma_gain or 0.0, alignment.bias or 0.0
    spread = REPORT_SIGMAS * np.hypot(sigma, scale_error)
    if abs(gain - 1.0) > spread and not _gain_fault(gain, sigma, scale_error):
        check = "; check scale and frame rate, forces go with both" if abs(gain - 1.0) > GAIN_TOLERANCE + spread else ""
        seen = f"the camera sees {gain:.4g} +/- {sigma:.2g} times what it says"
        found.append(f"{seen}; taken out as its sensitivity{check}")
    if REPORT_SIGMAS * (alignment.sigma_bias or 0.0) < abs(bias) <= GRAVITY:
        tilt = np.degrees(np.arcsin(abs(bias) / GRAVITY))
        found.append(f"its zero is off by {bias:.3g} m/s^2 (as a tilt of {tilt:.2g} deg would do); taken out")
    if alignment.sigma_rate is not None:
        ppm, sigma_ppm = 1e6 * alignment.rate, 1e6 * alignment.sigma_rate
        found.append(f"its clock runs {ppm:.3g} +/- {sigma_ppm:.2g} ppm fast against the camera's; taken out")
    if count := int(np.sum(series.clipped)):
        top = float(np.max(np.abs(series.values[series.clipped])))
        found.append(f"{count} of its samples are clipped at {top:.4g}: they are left out; take a wider range")
    return found


def _rms_difference(problem: AlignmentProblem, alignment: Alignment) -> tuple[float, float, float]:
    """Rms of the difference's means, the part that both noises explain, and the duration of a mean."""
    frames, series = problem.frames, problem.series
    gain, bias = alignment.gain or 1.0, alignment.bias or 0.0
    sensed = frames.sensor_differences(series, alignment.lag(frames.t)[:, None])[:, 0]
    residual = frames.z - gain * sensed / (1.0 + alignment.rate) ** 2 - bias
    white = Whitener(frames.camera + (gain * series.sigma) ** 2 * frames.noise(series, alignment.offset))
    count = min(N_WINDOWS, len(residual) // 2)
    means = (np.arange(len(residual)) * count // len(residual))[:, None] == np.arange(count)
    columns = white(means.astype(float))
    covariance = np.linalg.inv(columns.T @ columns)
    difference = covariance @ (columns.T @ white(residual))
    window = len(residual) / count * frames.interval
    return float(np.sqrt(np.mean(difference**2))), float(np.sqrt(np.mean(np.diag(covariance)))), window


@dataclass(frozen=True)
class ReleaseEnergy:
    """Kinetic energy at release.

    Attributes
    ----------
    kinetic, sigma : float
        Energy and its standard deviation, J.
    share : float
        Over the stated energy.
    verdict : str
        "plausible", "impossible" or "suspicious".
    says : str
        One sentence for the user.

    """

    kinetic: float
    sigma: float
    share: float
    verdict: str  # "plausible", "impossible", "suspicious"
    says: str


def release_energy(
    mass: tuple[float, float], speed: tuple[float, float], stated: float, scale_error: float = 0.0
) -> ReleaseEnergy:
    """Compare the kinetic energy m v^2 / 2 at release with the stated energy of the impact.

    `mass`, `speed`: value and standard deviation, kg and m/s; `stated`: energy of the impact, J; `scale_error`:
    relative standard deviation of the scale; the energy is proportional to its square. Returns the energy and verdict.

    Examples
    --------
    >>> release_energy((0.5, 0.0), (2.0, 0.0), stated=2.0).verdict
    'plausible'

    """
    (m, sigma_m), (v, sigma_v) = mass, speed
    kinetic = 0.5 * m * v**2
    relative = np.sqrt((sigma_m / m) ** 2 + (2.0 * sigma_v / v) ** 2 + (2.0 * scale_error) ** 2) if v else 0.0
    sigma, share = float(kinetic * relative), float(kinetic / stated)
    verdict, says = "plausible", f"E_kin / E_impact = {share:.2g}"
    at_release = f"the kinetic energy at release, {kinetic:.3g} +/- {sigma:.2g} J, is"
    if kinetic - IMPOSSIBLE_SIGMAS * sigma > stated:
        verdict = "impossible"
        says = (
            f"{at_release} more than the {stated:g} J of the blow: scale or frame rate is too large by a factor of "
            f"{np.sqrt(share):.3g} or more, or the mass by {share:.3g}; check these, or impact_energy"
        )
    elif share < SUSPICIOUS_SHARE:
        verdict, factor = "suspicious", 1 / max(share, 1e-300)
        says = (
            f"{at_release} less than a tenth of the {stated:g} J of the blow: scale or frame rate too small by a "
            f"factor of up to {np.sqrt(factor):.3g}, or the mass by {factor:.3g}, would explain it, as would a "
            "glancing blow; check these, or impact_energy"
        )
    return ReleaseEnergy(kinetic, sigma, share, verdict, says)
