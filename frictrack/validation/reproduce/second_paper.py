"""Second paper: identify the Stribeck model with and without the sine filter by SGA (Figs. 4-7, Tables 1 and 2)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from frictrack.records import Array
from frictrack.validation.reproduce import figures, laws
from frictrack.validation.reproduce import papers_method as method
from frictrack.validation.reproduce.sections import (
    FULL,
    OPEN,
    Claim,
    Effort,
    ResultTable,
    Section,
    claim,
    figure,
    section,
    table,
    verdict,
)

TIME_UNIT = "millisecond"  # per sample, 2.86 of Table 2 would be 1.8 kHz; per second, no sine completes a cycle


def sine_filter(effort: Effort = FULL, seed: int = 0) -> Section:
    """Reproduce Figs. 4-7 and Tables 1 and 2 of the second paper.

    Parameters
    ----------
    effort
        Seeds and evaluations.
    seed
        Seed of the recording.

    Returns
    -------
    Section
        Tables, figures and claims.

    """
    rng = np.random.default_rng([seed, 2])
    truth = laws.read_printed(laws.WITH_FILTER, TIME_UNIT)
    recording = method.record_printed(laws.WITH_FILTER, TIME_UNIT, method.STRUCK, rng)
    data = _sensor_series(recording, rng)
    results = {name: method.identify(laws.law_by_name(name), data, effort, rng, "sga") for name in ("tustin", "atm1:2")}
    rounded = _search_rounded_bounds(data, effort)
    own = {name: method.fit_with_frictrack(name, recording.run) for name in results}
    traces = {
        what: (data, [("SGA", found.acceleration(found.chosen))])
        for what, found in zip(("without", "with"), results.values(), strict=True)
    }
    strong, weak = 1e6 * truth[4::3] / method.STRUCK.mass / (2 * np.pi * truth[5::3]) ** 2  # F/(m omega^2), um
    return section(
        "sine_filter",
        [_table_static(results, rounded, own, truth), _table_sines(results["atm1:2"], truth)],
        [
            figure("second_fig04_05_motion", figures.motions, {"struck with 2 J": [recording]}),
            figure("second_fig06_07_friction", partial(figures.traces, as_force=True), traces),
        ],
        *_claims(results, rounded, own, truth),
        mass=method.STRUCK.mass,
        speed=recording.truth.v[0],
        noise=method.SENSOR_NOISE,
        strong=strong,
        weak=weak,
    )


def _sensor_series(recording: method.SyntheticRecording, rng: np.random.Generator) -> method.AccelerationSeries:
    """Velocity from the camera and acceleration from the sensor; no frames are left out at the ends."""
    motion = recording.run.motion
    a = recording.truth.a + method.SENSOR_NOISE * rng.standard_normal(len(motion.t))
    return method.AccelerationSeries(motion.t, motion.v, a, method.STRUCK.mass)


def _search_rounded_bounds(data: method.AccelerationSeries, effort: Effort) -> Array:
    """Parameters by SGA without the sine filter within bounds at the round numbers of Table 1, (seeds, 4)."""
    law = laws.tustin()
    bounds = method.search_bounds(law)
    bounds[[0, 2], 1] = np.array(laws.WITHOUT_FILTER.values)[[0, 2]]
    options: dict[str, Any] = {"budget": effort.budget, "bounds": bounds}
    seeds = range(effort.identified)
    return np.array([method.search_parameters(law, data, "sga", seed=i, **options).x for i in seeds])


def _table_static(
    results: dict[str, method.Identification], rounded: Array, own: dict[str, Any], truth: Array
) -> ResultTable:
    without, full = results["tustin"], results["atm1:2"]
    rows: list[list[Any]] = []
    for i, name in enumerate(without.law.names):
        left = float(without.chosen[i]), method.range_over_seeds(without, i), float(np.median(rounded[:, i]))
        right = float(full.chosen[i]), method.range_over_seeds(full, i), method.estimate_text(own["atm1:2"], name)
        ours = method.estimate_text(own["tustin"], name)
        rows.append([name, laws.WITHOUT_FILTER.values[i], *left, ours, truth[i], *right])
    return table("second_tables_1_2", rows)


def _table_sines(found: method.Identification, truth: Array) -> ResultTable:
    rows: list[list[Any]] = [
        [
            found.law.names[i],
            laws.WITH_FILTER.values[i],
            truth[i],
            float(found.chosen[i]),
            method.range_over_seeds(found, i),
        ]
        for i in range(4, len(truth))
    ]
    return table("second_table_2_sines", rows)


def _claims(
    results: dict[str, method.Identification], rounded: Array, own: dict[str, Any], truth: Array
) -> tuple[Claim, ...]:
    without, full = results["tustin"], results["atm1:2"]
    floor = method.squared_error(full.law, truth, full.data)
    far = {name: np.abs(np.array(result.found)[:, :4] / truth[:4] - 1) for name, result in results.items()}
    median = {name: float(np.median(x.mean(axis=1))) for name, x in far.items()}
    at_edge = np.abs(rounded[:, [0, 2]] / np.array(laws.WITHOUT_FILTER.values)[[0, 2]] - 1) < 1e-3
    fitted = own["atm1:2"]
    lost = [n for n, address in method.ADDRESSES.items() if fitted is None or fitted.parameters[address].value is None]
    missing = f" The recording does not hold {', '.join(lost)}: our fit says so, a search prints a number."
    better = median["atm1:2"] < median["tustin"]
    errors = f"lowest error {without.lowest:.3g} without, {full.lowest:.3g} with (m/s²)²"
    errors = f"{errors}; the rendered law itself leaves {floor:.3g}"
    relative = f"{100 * median['tustin']:.0f} % without, {100 * median['atm1:2']:.0f} % with"
    edges = f"F_c ends at the bound in {int(at_edge[:, 0].sum())} and F_v in {int(at_edge[:, 1].sum())}"
    return (
        claim("filter_follows", verdict(without.lowest / full.lowest > 1.05), errors),
        claim(
            "filter_precision",
            verdict(better and median["atm1:2"] < 0.1, not better),
            f"mean relative error of the four, median over seeds: {relative}",
            missing=missing if lost else "",
        ),
        claim("round_numbers", OPEN, f"in a box that ends there, {edges} of {len(rounded)} runs"),
    )
