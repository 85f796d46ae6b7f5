"""An accelerometer beside the camera: aligned, compared and fused. Truth: motions in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.special import erf

from frictrack.base.errors import FrictrackError
from frictrack.measure.plausibility import implausible_sensors
from frictrack.measure.sensors import (
    Alignment,
    AlignmentProblem,
    SensorComparison,
    SensorRecord,
    align,
    compare_with_camera,
    known_acceleration,
    release_energy,
    second_differences,
)
from frictrack.records import Array, Displacement

OMEGA, SHAKE = 2 * np.pi * 60.0, 5.7  # rad/s, m/s^2: a vibration
DECAY = 1.3  # 1/s, of what viscous friction adds
BLOW, AT, WIDTH = 0.06, 0.11, 0.6e-3  # m/s, s, s: a collision of Gaussian shape
FPS, FRAMES, NOISE = 4000.0, 800, 1e-5  # of the camera; m
DELAY, GAIN, BIAS = 3.37e-3, 1.03, 0.4  # of the sensor: s, 1, m/s^2


def a_true(t: Array) -> Array:
    smooth = -6.0 + 2.0 * np.exp(-DECAY * t) + SHAKE * np.sin(OMEGA * t + 0.4)
    return smooth - BLOW / (np.sqrt(2 * np.pi) * WIDTH) * np.exp(-(((t - AT) / WIDTH) ** 2) / 2)


def x_true(t: Array) -> Array:
    smooth = 4.0 * t - 3.0 * t**2 + 2.0 * (np.exp(-DECAY * t) - 1 + DECAY * t) / DECAY**2
    u = (t - AT) / WIDTH
    blow = BLOW * WIDTH * (u / 2 * (1 + erf(u / np.sqrt(2))) + np.exp(-(u**2) / 2) / np.sqrt(2 * np.pi))
    return smooth - SHAKE / OMEGA**2 * np.sin(OMEGA * t + 0.4) - blow


def film(rng: np.random.Generator, *, sigma: float = NOISE, x: Callable[[Array], Array] = x_true) -> Displacement:
    t = np.arange(FRAMES) / FPS
    nan = np.full(FRAMES, np.nan)
    seen = x(t) + sigma * rng.standard_normal(FRAMES)
    return Displacement(t, seen, nan, nan, np.full(FRAMES, sigma), nan, np.ones(FRAMES, bool))


@dataclass(frozen=True)
class Sensor:
    """An accelerometer that shows at its clock's time ts what happened at ts - delay."""

    rate: float = 1e4  # Hz
    noise: float = 0.5  # m/s^2
    gain: float = GAIN
    bias: float = BIAS
    delay: float = DELAY
    fast: float = 0.0  # of its clock, relative

    def record(self, rng: np.random.Generator) -> SensorRecord:
        ts = np.arange(-0.05, 0.3, 1.0 / self.rate) + rng.uniform(0, 1.0 / self.rate)
        felt = (a_true((ts - self.delay) / (1.0 + self.fast)) - self.bias) / self.gain
        return SensorRecord(ts, felt + self.noise * rng.standard_normal(len(ts)), "acc.csv")


def problem(seen: Displacement, series: SensorRecord) -> AlignmentProblem:
    frames = second_differences(seen)
    return AlignmentProblem(frames, series, np.ones((len(frames.z), 1)), series.sigma)


def found(
    seed: int, sensor: Sensor, changed: Callable[[SensorRecord], SensorRecord] = lambda s: s, **camera: float
) -> tuple[Alignment, SensorComparison]:
    rng = np.random.default_rng(seed)
    both = problem(film(rng, **camera), changed(sensor.record(rng)))
    aligned = align(both)
    return aligned, compare_with_camera(both, aligned)


@cache
def found_plain(seed: int) -> tuple[Alignment, SensorComparison]:
    """What is found of a plain sensor, computed once for all tests."""
    return found(seed, Sensor())


def altered(change: Callable[[Array, Array], Array]) -> Callable[[SensorRecord], SensorRecord]:
    return lambda s: SensorRecord(s.t, change(s.t, s.values), s.name)


def test_second_differences_hold_for_any_motion_and_any_gap() -> None:
    """The sensor's integral under the triangle is the camera's difference, exactly: no filter, no approximation."""
    t = np.arange(400) / FPS
    kept = np.setdiff1d(np.arange(400), [50, 51, 120])
    nan = np.full(len(kept), np.nan)
    seen = Displacement(t[kept], x_true(t[kept]), nan, nan, np.full(len(kept), 1e-6), nan, np.ones(len(kept), bool))
    fine = np.arange(-0.01, 0.12, 2e-6)
    frames = second_differences(seen)
    felt = frames.sensor_differences(SensorRecord(fine, a_true(fine)), np.zeros(1))[:, 0]
    assert len(frames.z) == len(kept) - 2
    np.testing.assert_allclose(felt, frames.z, atol=2e-5)


def test_the_stated_noise_of_the_differences_is_theirs() -> None:
    """Of the camera and of a sensor that is faster, and of one that is slower, than the camera."""
    rng = np.random.default_rng(0)
    frames = second_differences(film(rng, x=lambda t: 0.0 * t))
    assert np.mean(frames.z**2) == pytest.approx(np.mean(frames.camera.diagonal()), rel=0.15)
    for rate in (5e4, 1e3):
        ts = np.arange(-0.05, 0.3, 1 / rate)
        alone = np.concatenate(
            [frames.sensor_differences(SensorRecord(ts, rng.standard_normal(len(ts))), np.zeros(1)) for _ in range(40)],
            axis=1,
        )
        stated = frames.noise(SensorRecord(ts, 0 * ts), 0.0)
        assert np.mean(alone**2) == pytest.approx(np.mean(stated.diagonal()), rel=0.15)
        assert np.mean(alone[1:] * alone[:-1]) == pytest.approx(np.mean(stated.diagonal(1)), rel=0.2)


@pytest.mark.parametrize("sensor", [Sensor(), Sensor(rate=5e4, noise=5.0), Sensor(rate=1e3)])
def test_offset_gain_and_bias_are_found_within_their_deviations(sensor: Sensor) -> None:
    aligned, compared = found(1, sensor)
    assert aligned.sigma_offset is not None
    assert aligned.sigma_gain is not None
    assert aligned.sigma_bias is not None
    assert abs(aligned.offset + DELAY) < 4 * aligned.sigma_offset
    assert abs(aligned.gain - GAIN) < 4 * aligned.sigma_gain
    assert abs(aligned.bias - BIAS) < 4 * aligned.sigma_bias
    assert aligned.sigma_offset < 0.25 / FPS  # far below one frame
    assert compared.verdict == "consistent"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "sigma"),
    [
        (Sensor(), NOISE),
        (Sensor(rate=5e4, noise=5.0), NOISE),
        (Sensor(rate=1e3), NOISE),
        (Sensor(rate=5e4), 2e-6),
        (Sensor(), 5e-5),
    ],
)
def test_z_scores_of_offset_gain_and_bias_are_standard(sensor: Sensor, sigma: float) -> None:
    z = []
    for seed in range(120):
        aligned, _ = found(seed, sensor, sigma=sigma)
        off = np.array([aligned.offset + DELAY, aligned.gain - GAIN, aligned.bias - BIAS])
        z.append(off / np.array([aligned.sigma_offset, aligned.sigma_gain, aligned.sigma_bias], dtype=float))
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    most = 1.12 if sigma < 5e-5 else 1.2  # a delay of half a frame is no small error any more: it bends the likelihood
    assert np.all((rms > 0.88) & (rms < most)), rms


@pytest.mark.slow
def test_z_scores_are_standard_over_few_seeds() -> None:
    z = []
    for seed in range(10):
        aligned, _ = found_plain(seed)
        z.append((aligned.offset + DELAY) / float(aligned.sigma_offset or np.nan))
    assert 0.55 < np.sqrt(np.mean(np.square(z))) < 1.4


@pytest.mark.slow
def test_the_gain_is_not_too_small_under_noise() -> None:
    """A regressor with noise attenuates; its expected share is taken out."""
    gains = [found(seed, Sensor(rate=1e3, noise=1.5))[0].gain or 0.0 for seed in range(8)]
    assert np.mean(gains) == pytest.approx(GAIN, abs=4 * np.std(gains) / np.sqrt(8))
    assert np.std(gains) / np.sqrt(8) < 0.03


def test_two_clocks_at_different_rates_are_told_apart() -> None:
    fast = 3000e-6
    aligned, compared = found(3, Sensor(noise=0.1, fast=fast), sigma=1e-6)
    assert aligned.sigma_rate is not None
    assert abs(aligned.rate - fast) < 4 * aligned.sigma_rate + fast**2
    assert any("ppm fast" in said for said in compared.says)
    assert found(3, Sensor(noise=0.1), sigma=1e-6)[0].sigma_rate is None


def test_a_clock_far_off_is_found_without_help() -> None:
    rng = np.random.default_rng(5)
    series = Sensor().record(rng)
    aligned = align(problem(film(rng), SensorRecord(series.t + 1000.0, series.values, "acc.csv")))
    assert aligned.sigma_offset is not None
    assert abs(aligned.offset + 1000.0 + DELAY) < 4 * aligned.sigma_offset


def test_a_periodic_motion_is_ambiguous_and_its_deviation_spans_the_periods() -> None:
    rng = np.random.default_rng(7)
    ts = np.arange(-0.1, 0.3, 1e-4)
    series = SensorRecord(ts, SHAKE * np.sin(OMEGA * (ts - 2e-3)) + 0.3 * rng.standard_normal(len(ts)), "acc.csv")
    both = problem(film(rng, x=lambda t: 3 * t - SHAKE / OMEGA**2 * np.sin(OMEGA * t)), series)
    aligned = align(both)
    assert abs(aligned.offset + 2e-3) < 4 * (aligned.sigma_offset or 0.0)
    assert (aligned.sigma_offset or 0.0) > 2 * np.pi / OMEGA
    assert compare_with_camera(both, aligned).verdict == "not compared"
    assert aligned.reason.startswith("ambiguous")


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("sensor", "change", "cause"),
    [
        (Sensor(gain=1.5), None, "the scale is too large by this factor, or the frame rate by"),
        (Sensor(gain=9.80665, noise=0.05), None, "it is in units of gravity: say so with columns"),
        (Sensor(gain=-1.0), None, "its axis points the other way: flip its sign"),
        (Sensor(gain=1e-3, noise=500.0), None, "it is in mm/s^2: say so"),
        (Sensor(bias=20.0), None, "its zero is off by 20"),
        (
            Sensor(),
            lambda t, a: a + 20 * np.sin(2 * np.pi * 333 * t),
            "one sinusoid at 333 Hz: most likely its mounting",
        ),
        (Sensor(), lambda t, a: a + 60 * (t - 0.1), "they differ slowly: a sensor that drifts"),
        (
            Sensor(),
            lambda t, a: a + np.where(abs(t - 0.1525) < 0.0025, 60 * np.sin(2513 * t), 0),
            "they differ from 0.15",
        ),
    ],
)
def test_a_disagreement_names_its_cause(
    sensor: Sensor, change: Callable[[Array, Array], Array] | None, cause: str
) -> None:
    _, compared = found(0, sensor, altered(change) if change else lambda s: s)
    assert compared.verdict == "disagrees"
    assert cause in compared.says[0]


def test_agreement_is_not_doubted_by_chance() -> None:
    assert [found_plain(seed)[1].verdict for seed in range(10)].count("consistent") >= 9


def test_clipped_samples_are_left_out_and_said() -> None:
    aligned, compared = found(0, Sensor(), altered(lambda t, a: np.clip(a, -25.0, 25.0)))
    assert compared.verdict == "consistent"
    assert abs(aligned.offset + DELAY) < 4 * (aligned.sigma_offset or 0.0)
    assert any("of its samples are clipped at 25: they are left out" in said for said in compared.says)
    rng = np.random.default_rng(0)
    series = altered(lambda t, a: np.clip(a, -25.0, 25.0))(Sensor().record(rng))
    assert not np.any(series.known[np.abs(series.values) >= 25.0])
    assert np.sum(~series.known) == np.sum(np.abs(series.values) >= 25.0)
    coarse = SensorRecord(series.t, np.round(np.sin(40 * series.t), 1), "coarse")
    assert not np.any(coarse.clipped)  # a coarse record holds its values everywhere


def test_a_given_offset_is_kept_and_refuted_where_it_is_wrong() -> None:
    rng = np.random.default_rng(2)
    both = problem(film(rng), Sensor().record(rng))
    right, wrong = align(both, -DELAY), align(both, -DELAY - 5e-4)
    assert (right.offset, right.sigma_offset) == (-DELAY, None)
    assert compare_with_camera(both, right).verdict == "consistent"
    said = " ".join(compare_with_camera(both, wrong).says)
    assert "the offset of -3.87 ms is wrong, the data give -3.4" in said
    assert 'offset = "auto"' in said


def test_a_fused_acceleration_is_the_truth_within_its_noise() -> None:
    rng = np.random.default_rng(4)
    seen = film(rng)
    for sensor in (Sensor(rate=5e4, noise=1.0), Sensor()):
        both = problem(seen, sensor.record(rng))
        aligned = align(both)
        fused = known_acceleration(both.series, aligned, seen.t)
        h = 1.0 / FPS
        fine = seen.t[:, None] + np.linspace(-h / 2, h / 2, 41)
        error = fused.a - np.mean(a_true(fine), axis=1)
        error -= np.mean(error)  # the bias is known to sigma_bias only, which is not white
        assert np.std(error) == pytest.approx(fused.sigma, rel=0.2)
        assert fused.sigma == pytest.approx(GAIN * sensor.noise / np.sqrt(sensor.rate * h), rel=0.1)


def test_an_average_takes_away_what_the_frames_cannot_hold() -> None:
    ts = np.arange(0, 0.1, 2e-5)
    series = SensorRecord(ts, 3.0 + np.sin(2 * np.pi * 4000 * ts))  # one period per frame: it would be folded to 0 Hz
    at = np.arange(0.01, 0.09, 1 / FPS)
    np.testing.assert_allclose(series.average(at, 1 / FPS), 3.0, atol=1e-4)
    slow = SensorRecord(ts[::50], np.sin(2 * np.pi * 50 * ts[::50]))  # 1 kHz: between its samples the curve goes on
    np.testing.assert_allclose(slow.average(at, 1 / FPS), np.sin(2 * np.pi * 50 * at), atol=1e-3)


@pytest.mark.parametrize("rate", [0.7, 1.0, 1.3, 4.0])  # samples per frame
def test_white_noise_of_samples_is_white_at_the_frames_next_to_them(rate: float) -> None:
    ts = (np.arange(8000 * rate) + 0.37) / (rate * FPS)
    noise, at = np.random.default_rng(5).normal(size=len(ts)), np.arange(10, 7990) / FPS
    made = SensorRecord(ts, noise).means(at)
    known = np.isfinite(made)
    assert np.mean(known) == pytest.approx(min(rate, 1.0), abs=0.01)
    left = made[known]
    assert np.std(left) == pytest.approx(np.sqrt(len(left) / len(ts)), rel=0.06)
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 4 / np.sqrt(len(left))
    smooth = SensorRecord(ts, np.cos(300 * ts)).means(at)
    np.testing.assert_allclose(smooth[known], np.cos(300 * at[known]), atol=2e-3)


def test_integrals_go_on_outside_the_record_with_its_end_value() -> None:
    """A record 2 + 3 t over one second: before it the value is 2, after it 5."""
    ts = np.linspace(0.0, 1.0, 11)
    series, at = SensorRecord(ts, 2 + 3 * ts), np.array([-0.5, 0.5, 1.0, 1.5])
    np.testing.assert_allclose(series.integral(at, 0), [2.0, 3.5, 5.0, 5.0], rtol=1e-12)
    np.testing.assert_allclose(series.integral(at, 1), [-1.0, 1.375, 3.5, 3.5 + 2.5], rtol=1e-12)
    np.testing.assert_allclose(series.integral(at, 2), [0.25, 0.3125, 1.5, 1.5 + 1.75 + 0.625], rtol=1e-12)


def test_where_the_sensor_was_not_running_nothing_is_known() -> None:
    ts = np.arange(0, 0.1, 1e-4)
    values = np.cos(40 * ts)
    values[300:330] = np.nan
    gone = np.concatenate([ts[:600], ts[650:]])
    series = SensorRecord(gone, np.concatenate([values[:600], values[650:]]))
    at = np.arange(-0.01, 0.11, 1 / FPS)
    mean = series.average(at, 1 / FPS)
    lost = (at < -1.3e-4) | (at > 0.1001) | ((at > 0.0299) & (at < 0.0331)) | ((at > 0.0599) & (at < 0.0651))
    assert np.all(np.isnan(mean[lost]))
    assert np.mean(np.isfinite(mean[~lost])) > 0.99
    assert np.nanmax(np.abs(mean - np.cos(40 * at))) < 1e-3


def test_gaps_do_not_spoil_the_alignment() -> None:
    aligned, compared = found(0, Sensor(), altered(lambda t, a: np.where(abs(t - 0.08) < 0.01, np.nan, a)))
    assert abs(aligned.offset + DELAY) < 4 * (aligned.sigma_offset or 0.0)
    assert compared.verdict == "consistent"


@pytest.mark.parametrize(
    ("t", "values", "expected"),
    [
        ([0, 1, 0.5], [1, 2, 3], "acc: expected rising time but got 0.5 s after 1 s in row 3"),
        ([0], [1], "acc: expected at least 2 samples but got 1"),
        ([0, 1, 2], [1, 2], "acc: expected one value per time but got (2,) values at (3,) times"),
        ([0, 1, 2, 3], [1, np.nan, np.nan, np.nan], "acc: expected numbers but 3 of 4 samples are none"),
    ],
)
def test_a_record_that_is_none_is_refused(t: list[float], values: list[float], expected: str) -> None:
    with pytest.raises(FrictrackError) as caught:
        SensorRecord(np.array(t), np.array(values, dtype=float), "acc")
    assert expected in str(caught.value)


def test_what_cannot_be_aligned_says_why() -> None:
    rng = np.random.default_rng(0)
    seen = film(rng)
    ts = np.arange(-0.05, 0.3, 1e-4)
    assert align(problem(seen, SensorRecord(ts, 0 * ts + 2))).reason == (
        "it is constant, so that no offset can be determined; 0 is kept"
    )
    noise = align(problem(seen, SensorRecord(ts, rng.standard_normal(len(ts)))))
    assert noise.sigma_offset is None
    assert noise.offset == 0.0
    assert "at no offset" in noise.reason
    assert compare_with_camera(problem(seen, SensorRecord(ts, 0 * ts + 2)), noise).verdict == "not compared"
    two = align(problem(seen, SensorRecord(np.array([0.0, 0.1]), np.array([1.0, 2.0]))))
    assert two.reason == "expected at least 16 samples but got 2; 0 is kept"
    apart = align(problem(seen, Sensor().record(rng)), 7.0)
    assert "as given, it was running from 6.95" in apart.reason
    few = replace(seen, **{k: getattr(seen, k)[:10] for k in ("t", "x", "y", "angle", "sigma_x", "sigma_y", "valid")})
    assert "expected at least 16 neighbouring frames but got 8" in align(problem(few, Sensor().record(rng))).reason


def test_the_energy_of_the_blow_bounds_the_slider() -> None:
    """2 J, as the second paper's hammer; 0.35 kg at 3.08 m/s carry 1.66 J."""
    good = release_energy((0.35, 0.002), (3.08, 0.01), 2.0)
    assert good.verdict == "plausible"
    assert good.says == "E_kin / E_impact = 0.83"
    assert good.sigma == pytest.approx(1.66 * np.hypot(0.002 / 0.35, 0.02 / 3.08), rel=1e-3)
    fast = release_energy((0.35, 0.002), (2 * 3.08, 0.01), 2.0)
    assert fast.verdict == "impossible"
    assert "scale or frame rate is too large by a factor of 1.82 or more, or the mass by 3.32" in fast.says
    assert release_energy((0.35, 0.002), (3.6, 0.01), 2.0, scale_error=0.05).verdict == "plausible"  # 2.27 +/- 0.23 J
    slow = release_energy((0.35, 0.002), (0.5, 0.01), 2.0)
    assert slow.verdict == "suspicious"
    assert "less than a tenth of the 2 J of the blow: scale or frame rate too small by a factor of up to" in slow.says


def _ringing(seed: int, gain: float, delay: float, frequency: float = 300.0) -> AlignmentProblem:
    """A vibration that an impact starts once more half-way, on a slide under constant friction: closed form."""
    rng, omega = np.random.default_rng(seed), 2 * np.pi * frequency
    s, struck, t, ts = -1 / 0.05 + 1j * omega, 0.06, np.arange(480) / FPS, np.arange(-0.03, 0.16, 6e-5)

    def x(at: Array) -> Array:
        u = np.maximum(at - struck, 0.0)
        return 2 * at - 3 * at**2 + np.imag(4 * np.exp(s * at) / s**2 + 3 * (np.exp(s * u) - 1 - s * u) / s**2)

    def a(at: Array) -> Array:
        return -6 + np.imag(4 * np.exp(s * at) + 3 * np.exp(s * np.maximum(at - struck, 0.0)))

    nan = np.full(len(t), np.nan)
    seen = x(t) + 1e-6 * rng.standard_normal(len(t))
    series = SensorRecord(ts, a(ts - delay) / gain + 0.3 * rng.standard_normal(len(ts)), "acc.csv")
    return problem(Displacement(t, seen, nan, nan, np.full(len(t), 1e-6), nan, np.ones(len(t), bool)), series)


@pytest.mark.few(2)
@pytest.mark.parametrize(("gain", "delay"), [(0.92, 2.3e-3), (1.1, 4.4e-3), (0.85, 0.7e-3), (-1.0, 2.3e-3)])
def test_no_delay_of_a_ringing_slide_is_wrong_without_being_called_ambiguous(gain: float, delay: float) -> None:
    for seed in range(3):
        both = _ringing(seed, gain, delay)
        aligned = align(both)
        assert abs(aligned.offset + delay) < 5 * (aligned.sigma_offset or 0.0)
        assert aligned.reason.startswith("ambiguous") == bool(aligned.rivals)
        modes = [(aligned.offset, aligned.gain or 0.0, 1.0), *aligned.rivals]
        assert min(abs(o + delay) + abs(g / gain - 1) for o, g, _ in modes) < 0.3
        used = compare_with_camera(both, aligned).verdict == "consistent"
        assert used == (not aligned.rivals and gain > 0)


def test_one_rule_of_use_for_gains_that_a_sensitivity_explains() -> None:
    for gain in (0.916, 0.93, 1.2):
        compared = found(0, Sensor(gain=gain))[1]
        assert compared.verdict == "consistent"
        assert any("taken out as its sensitivity" in said for said in compared.says)
    assert any("check scale and frame rate" in said for said in compared.says)


def _clock(offset: float, gain: float, *rivals: list[float]) -> dict[str, object]:
    return {"offset_s": offset, "gain": gain, "sigma_offset_s": 1e-5, "sigma_gain": 0.01, "rivals": list(rivals)}


def test_one_sensor_has_one_sign_gain_and_delay_over_the_runs() -> None:
    rival, good = [-2.31e-3, 0.93, 0.2], _clock(-2.3e-3, 0.92)
    (said,) = implausible_sensors({"a": _clock(-0.66e-3, -0.97, rival), "b": good})
    assert 'ambiguous; the other runs have 2.3 ms and 0.92, and so may this one: set offset = "-2.3 ms"' in str(said)
    (said,) = implausible_sensors({"a": _clock(-0.66e-3, -0.97), "b": good, "c": good})
    assert str(said).startswith('run "a": its accelerometer has 0.66 ms delay and gain -0.97 where the other runs have')
    (said,) = implausible_sensors({"a": _clock(-0.66e-3, -0.97), "b": good})
    assert "differs between the runs" in str(said)
    assert not implausible_sensors({"a": good, "b": _clock(-7e-3, 0.9), "c": _clock(1.0, 0.95)})  # started by hand
    ambiguous = [[-2.3e-3 - k / 300, 0.9, 0.3] for k in (1, 2)]
    assert not implausible_sensors({"a": _clock(-2.3e-3, 0.9, *ambiguous), "b": _clock(-2.3e-3, 0.9, *ambiguous)})


def test_two_runs_whose_improbable_delays_coincide_have_no_common_one() -> None:
    far = [-6.2e-3, 0.9, 1e-3]
    assert not implausible_sensors({"a": _clock(-1e-3, 0.9, far), "b": _clock(-3e-3, 0.9, far)})
    said = implausible_sensors({"a": _clock(-1e-3, 0.9, [-3.0e-3, 0.9, 0.3]), "b": _clock(-3e-3, 0.9, far)})
    assert [one.correction for one in said] == ['offset = "-3 ms"'] * 2
