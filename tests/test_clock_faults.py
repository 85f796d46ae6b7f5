"""Clocks of laboratories: the law within its interval, or a refusal whose remedy works.

0.35 kg slides with F = 0.9 N + 0.2 N s/m v, in closed form, with 5 um of noise. Rates of 30 to 10 000 Hz, stamps
rounded to 1 us (8.64 us: Excel) up to 10 ms, and a fault of the clock.
"""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import pytest
from runs import plain_motion

import frictrack as ft
from frictrack.measure.tables import displacement_of_table
from frictrack.study import TableData, read_table, unrolled_clock

M, F_C, F_V = 0.35, 0.9, 0.2
LIMIT = 3.0  # standard deviations: a chance of 0.3 % in each of 60 values


def position(v0: float, t: np.ndarray) -> np.ndarray:
    """Position of the slide."""
    k, a = F_V / M, F_C / M
    return np.asarray(np.sign(v0) * ((abs(v0) + a / k) * (1 - np.exp(-k * t)) / k - a / k * t))


def record(rate: float, rounding: float, fault: str, v0: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and positions of one run with a fault."""
    rng, end = np.random.default_rng(seed), 0.97 * np.log(1 + F_V / F_C * abs(v0)) * M / F_V
    n = min(int(end * rate), 3000)
    t = np.arange(n) / rate
    stamps = None
    if fault == "jitter":
        t = t + 0.05 / rate * rng.standard_normal(n)
    elif fault == "written late":
        stamps = t + rng.exponential(0.15 / rate, n)
    elif fault == "drops":
        t = np.delete(t, rng.choice(np.arange(1, n - 1), max(n // 30, 2), replace=False))
    elif fault == "gap":
        t = np.delete(t, np.arange(n // 3, n // 3 + max(n // 20, 2)))
    elif fault == "changing rate":
        t = np.cumsum(np.r_[0.0, np.full(n // 2, 1.0), np.full(n // 4, 2.0)]) / rate
    x = position(v0, t) + 5e-6 * rng.standard_normal(len(t))
    stamps = t if stamps is None else stamps
    if fault == "doubles":
        rows = np.sort(np.r_[np.arange(n), rng.choice(n, max(n // 40, 1), replace=False)])
        stamps, x = stamps[rows], x[rows]
    stamps = np.round(stamps / rounding) * rounding
    if fault == "rollover":
        full = 2.0 ** np.ceil(np.log2(0.6 * stamps[-1] / rounding)) * rounding
        stamps = np.round(((stamps + 0.3 * full) % full) / rounding) * rounding
    return stamps + (86400 * 19000 if fault == "date" else 0.0), x


def law(folder: Path, rate: float, rounding: float, fault: str, fps: float | None) -> list[float]:
    """Deviations of the fitted law from the truth over its standard deviations, of two runs from tables."""
    made = []
    for seed, v0 in enumerate((2.0, -1.5)):
        columns = np.column_stack(record(rate, rounding, fault, v0, seed))
        np.savetxt(folder / "t.csv", columns, delimiter=",", header="t_s,x_m", comments="", fmt=["%.8f", "%.9f"])
        measured = displacement_of_table(read_table(folder / "t.csv", fps=fps), fps=fps)
        made.append(ft.Run(measured, plain_motion(measured), mass=M, name=f"r{seed}"))
    found = ft.fit(["coulomb", "viscous"], made).parameters
    pairs = ((found["coulomb.F_c"], F_C), (found["viscous.F_v"], F_V))
    return [(estimate.value - truth) / estimate.std for estimate, truth in pairs]


RATES = (30, 120, 300, 480, 1000, 2500, 10000)
ROUNDINGS = (1e-6, 8.64e-6, 1e-4, 1e-3, 1e-2)
FAULTS = ("none", "jitter", "written late", "drops", "gap", "changing rate", "doubles", "rollover", "date")
CASES = [(RATES[i % 7], ROUNDINGS[i % 5], FAULTS[(i + i // 9) % 9]) for i in range(36)]
UNKNOWABLE = ("expected at least 8", "give stamps with more digits")  # a few frames; rows that nothing counts


@pytest.mark.few(12)
@pytest.mark.parametrize(("rate", "rounding", "fault"), CASES)
def test_the_law_or_a_remedy_that_works(tmp_path: Path, rate: float, rounding: float, fault: str) -> None:
    try:
        off = law(tmp_path, rate, rounding, fault, None)
    except ft.FrictrackError as refusal:
        said = str(refusal)
        if any(words in said for words in UNKNOWABLE):
            assert rounding > 1 / rate or rate == 30
            return
        assert "fps" in said or "give the frame rate" in said
        off = law(tmp_path, rate, rounding, fault, rate)
    assert max(map(abs, off)) < LIMIT


@pytest.mark.parametrize("seed", [10, 20])
def test_rows_that_the_motion_cannot_count_are_refused_at_a_given_rate_too(seed: int) -> None:
    t, x = record(2500, 1e-2, "drops", 2.0 if seed == 10 else -1.5, seed)
    with pytest.raises(ft.FrictrackError, match="give stamps with more digits"):
        displacement_of_table(TableData(t, x), fps=2500)


@pytest.mark.few(2)
@pytest.mark.parametrize(("rate", "rounding"), [(120, 1e-2), (1000, 1e-2), (2500, 1e-2), (480, 1e-3)])
def test_the_error_of_a_fitted_clock_is_in_the_interval(tmp_path: Path, rate: float, rounding: float) -> None:
    columns = record(rate, rounding, "none", 2.0, 0)
    run = ft.Run.from_arrays(*columns, mass=M)
    n, span = len(columns[0]), columns[0][-1]
    error = run.displacement.clock_error  # at most that of the least-squares line, whose stamps are uniform in rounding
    assert 0 < error < 1.3 * rounding / np.sqrt(n) / span
    assert abs(np.mean(np.diff(run.displacement.t)) * rate - 1) < LIMIT * error
    estimate = ft.fit(["coulomb", "viscous"], [run]).parameters["coulomb.F_c"]
    assert estimate.std > 1.5 * run.displacement.clock_error * F_C  # forces go with the square of the rate
    assert abs(estimate.value - F_C) < LIMIT * estimate.std
    assert displacement_of_table(TableData(*columns), fps=rate).clock_error == 0.0


def test_a_clock_that_begins_anew_is_no_rollover() -> None:
    t = np.arange(200) / 100
    x = position(2.0, t[:100] % 1.0)
    again = np.r_[t[:100], t[:100]]
    assert unrolled_clock(again, np.r_[x, x])[1] == ()  # the positions jump back, too
    minute = (50 + np.arange(2000) / 100) % 60
    out, notes = unrolled_clock(minute, np.linspace(0, 1, 2000))
    assert np.all(np.diff(out) > 0)
    assert notes == ("the clock rolled over once, at 60 s: unwrapped",)


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%H:%M:%S.%f", "full seconds bare"])
def test_date_times_across_full_seconds_and_midnight(tmp_path: Path, form: str) -> None:
    begin = dt.datetime(2016, 5, 23, 23, 59, 59, 500000)
    t, x = record(200, 1e-6, "none", 2.0, 1)
    moments = [begin + dt.timedelta(microseconds=round(1e6 * one)) for one in t]
    written = [str(m) if form == "full seconds bare" else m.strftime(form) for m in moments]
    rows = "\n".join(f"{a},{b:.9f}" for a, b in zip(written, x, strict=True))
    (tmp_path / "t.csv").write_text(f"time,pos\n{rows}\n")
    found = read_table(tmp_path / "t.csv", {"t": "time", "x": "pos (m)"})
    np.testing.assert_allclose(np.diff(found.t), 0.005, atol=1e-9)


def test_halves_that_are_rounded_either_way_leave_the_interval_exact() -> None:
    """Six digits of a clock of 20 kHz: from 10 s on, every other stamp is half a step off."""
    t, x = record(20_000, 1e-9, "none", 2.0, 0)
    stamps = np.array([float(f"{9.9 + one:.6g}") for one in t])
    read = displacement_of_table(TableData(stamps, x))
    assert np.mean(np.diff(read.t)) == pytest.approx(5e-5, rel=1e-6)
    assert read.clock_error < 1e-6


def test_a_counter_of_24_bits_at_10_mhz_is_unwrapped() -> None:
    t = np.arange(800) / 1250
    counts = (np.round(t * 1e7) + 2**24 - 3_000_000) % 2**24
    out, notes = unrolled_clock(counts / 1e7, position(2.0, t))
    assert np.diff(out) == pytest.approx(np.diff(t), abs=1e-9)
    assert "1.6777216 s" in notes[0]
