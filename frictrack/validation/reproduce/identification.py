"""Identify the papers' laws on simulated recordings.

First paper, section 3: time units, the Tustin model, ATM1 and ATM2 (Tables 1-4, Figs. 4-16), readings of Eq. 4. Second
paper: the Stribeck model with and without the sine filter by SGA (Figs. 4-7, Tables 1 and 2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.fit import Fit, fit
from frictrack.records import Array, Run
from frictrack.validation.reproduce import figures, laws, sections
from frictrack.validation.reproduce import papers_method as method

Key = tuple[str, str, str]  # group, source of the recording, law
Identified = Mapping[Any, method.Identification]  # by group, by law, or by `Key`
Recordings = Mapping[tuple[str, str], method.SyntheticRecording]  # by group and source
Claims = tuple[sections.Claim, ...]
SPEEDS = {"low": (4.0, 4.5, 5.0), "high": (7.0, 7.5, 8.0)}  # m/s, section 3.1
DITHER_SHARE = 0.1  # of the printed sines, which are several times the friction that they would dither about
MIN_STRAIGHTNESS = 0.99  # share of a law's variation that a straight line in v explains: then it is one


def time_units() -> sections.Section:
    """Test which time unit behind the printed "rad/s" gives curves as the papers describe them.

    Returns
    -------
    Section
        Table and claims.

    """
    rows: list[list[Any]] = []
    fits: dict[str, list[str]] = {}
    for source in (*laws.ATM1.values(), *laws.ATM2.values(), laws.WITH_FILTER):
        bench = method.STRUCK if source is laws.WITH_FILTER else method.BEAM
        for unit in laws.UNITS:
            curve = method.describe_curve(source, unit, bench)
            numbers = [float(curve[key]) for key in ("lowest_Hz", "highest_Hz", "cycles", "duration_ms")]
            motion = [100 * float(curve["braked"]), float(curve["mean_force_N"])]
            rows.append([source.where, unit, *numbers, *motion, "yes" if curve["described"] else "no"])
            if curve["described"]:
                fits.setdefault(source.where, []).append(unit)
    without = [s.where for s in laws.ATM2.values() if s.where not in fits]
    units = "; ".join(f"{where}: per {' or '.join(units)}" for where, units in fits.items()) + "; others: none"
    never = f"no time unit gives a dither and a brake together for {' and '.join(without) or 'any'}"
    limits = {"slowest": method.MIN_SPEED, "longest": method.MAX_DURATION_S}
    claims = sections.claim("time_units", False, units), sections.claim("atm2_brakes", not without, never)
    return sections.section("time_units", [sections.table("time_units", rows, **limits)], [], *claims)


def tustin_groups(effort: sections.Effort = sections.FULL, seed: int = 0) -> sections.Section:
    """Reproduce Figs. 4-8: identify the Tustin model on the low-speed and on the high-speed group.

    Parameters
    ----------
    effort
        Seeds and evaluations.
    seed
        Seed of the recordings.

    Returns
    -------
    Section
        Table, figures and claims.

    """
    rng = np.random.default_rng([seed, 31])
    synthetic: dict[str, list[method.SyntheticRecording]] = {}
    results: dict[str, method.Identification] = {}
    traced: dict[str, tuple[Run, dict[str, Array]]] = {}
    for group, speeds in SPEEDS.items():
        laid = laws.TM[group], laws.ATM1[group]
        synthetic[group] = [method.record_with_dither(*laid, DITHER_SHARE, v, rng) for v in speeds]
        filtered = [method.friction_run(one.run) for one in synthetic[group]]
        results[group] = method.identify("tustin", method.as_points(filtered), effort)
        law = laws.to_effects("tustin", results[group].parameters)
        force = method.law_force(*law, method.time_speed_force(filtered[-1])[1])
        traced[method.GROUPS[group]] = filtered[-1], {"Tustin, MGA": force}
    runs = [run for group, made in synthetic.items() for run in method.group_runs(made, group)]
    try:
        ours, reason = dict(fit("tustin", runs, per="group").fits), ""
    except FrictrackError as e:
        ours, reason = {}, str(e)
    moved = {f"{group} speed": made for group, made in synthetic.items()}
    over_speed = {method.GROUPS[g]: (*found.data[1:], _force_curves(found, g)) for g, found in results.items()}
    rows = []
    for g, found in results.items():
        values = zip(laws.STATIC.items(), laws.TM[g].values, found.parameters, strict=True)
        for i, ((name, address), said, p) in enumerate(values):
            estimate = method.estimate_text(ours.get(g), address)
            rows.append([g, name, said, p, method.range_over_seeds(found, i), estimate])
    return sections.section(
        "tustin_groups",
        [sections.table("tustin_groups", rows, reason=reason and f" Ours: {reason}.")],
        [
            sections.figure("fig08_accelerations", figures.motions, moved),
            sections.figure("fig06_07_tustin", figures.traces, traced),
            sections.figure("tustin_over_speed", figures.forces, over_speed),
        ],
        *_claims_tustin(results, ours, reason),
    )


def _force_curves(found: method.Identification, group: str) -> list[tuple[str, Array, Array]]:
    v = np.linspace(found.data[1].min(), found.data[1].max(), 200)
    both = {"Tustin, MGA": found.parameters, "rendered, without sines": np.array(laws.TM[group].values)}
    return [(label, v, method.law_force(*laws.to_effects("tustin", p), v)) for label, p in both.items()]


def straightness(p: Array, v: Array) -> float:
    """Share of the variation of a Tustin model over measured speeds that a straight line in v explains."""
    force = method.law_force(*laws.to_effects("tustin", p), v)
    rest = force - np.polyval(np.polyfit(v, force, 1), v)
    return float(1 - rest.var() / max(force.var(), 1e-30))


def _claims_tustin(results: Identified, ours: Mapping[str, Any], reason: str) -> Claims:
    straight = {g: straightness(d.parameters, d.data[1]) for g, d in results.items()}
    left = {g: method.BEAM.mass**2 * d.lowest / (d.data[2].var() * len(d.data[2])) for g, d in results.items()}
    undetermined = [g for g in results if g in ours and ours[g].parameters["stribeck.v_s"].value is None]
    dithers = "; ".join(
        f"{100 * share:.0f} % of the acceleration's variance is left ({g})" for g, share in left.items()
    )
    lines = "; ".join(
        f"{g}: {100 * s:.2f} % straight, slowest {results[g].data[1].min():.1f} m/s" for g, s in straight.items()
    )
    found = (f"{d.parameters[1]:.3g} N ({g}, rendered {laws.TM[g].values[1]:.3g})" for g, d in results.items())
    known = f"not determined in {' and '.join(undetermined)}" if undetermined else "determined"
    stated, determined = f"MGA puts F_s at {', '.join(found)}; ours: {known}", "high" not in undetermined and not reason
    change = 100 * (laws.TM["high"].values[1] / laws.TM["low"].values[1] - 1)
    return (
        sections.claim("tustin_unsuitable", min(left.values()) > 0.1, dithers),
        sections.claim("tustin_straight", straight["high"] > MIN_STRAIGHTNESS, lines),
        sections.claim("tustin_groups", determined, stated, fails=False, change=change),
    )


SOURCE_TITLES = {
    "ATM1 tables": "from the ATM1 tables",
    "ATM2 tables": "from the ATM2 tables",
    "neither": "from neither model",
}
# laws by the figure of `orders` that shows them
ORDERS = {"fig13_atm1_2": "atm1:2", "fig14_atm1_3": "atm1:3", "fig15_atm2_2": "atm2:2", "fig16_atm2_3": "atm2:3"}


def two_models(effort: sections.Effort = sections.FULL, seed: int = 0) -> sections.Section:
    """Reproduce Tables 1-4 and Figs. 9-12: both models with n = 2 on recordings of either model, and of neither.

    Parameters
    ----------
    effort
        Seeds and evaluations.
    seed
        Seed of the recordings.

    Returns
    -------
    Section
        Tables, figures and claims.

    """
    rng = np.random.default_rng([seed, 32])
    synthetic = {(g, w): r for g in method.GROUPS for w, r in method.simulate_sources(g, rng).items()}
    results = _identify_all(synthetic, ("atm1:2", "atm2:2"), effort)
    bars = {
        f"{name.upper()}, {what}": [
            float(r.errors.min()) if what == "MGA" else r.lowest
            for (*_, law), r in results.items()
            if law == f"{name}:2"
        ]
        for name in ("atm1", "atm2")
        for what in ("MGA", "lowest")
    }
    places = [f"{g} speed,\n{SOURCE_TITLES[w]}" for g, w in synthetic]
    return sections.section(
        "two_models",
        [_table_errors("errors", results), *_tables_parameters(results, synthetic)],
        [
            _traces("fig09_10_atm1", results, {t: (g, "ATM1 tables", "atm1:2") for g, t in method.GROUPS.items()}),
            _traces("fig11_12_atm2", results, {t: (g, "ATM2 tables", "atm2:2") for g, t in method.GROUPS.items()}),
            sections.figure("errors_two_models", figures.bars, "sum of squared residuals / (m²/s⁴)", places, bars),
        ],
        *_claims_models(results, effort),
    )


def orders(effort: sections.Effort = sections.FULL, seed: int = 0) -> sections.Section:
    """Reproduce Figs. 13-16: two and three sines at low speed, and ATM1 with four, as many as ATM2 with n = 2.

    Parameters
    ----------
    effort, seed
        As in `two_models`.

    Returns
    -------
    Section
        Table, figures and claims.

    """
    rng = np.random.default_rng([seed, 33])
    synthetic = {("low", w): r for w, r in method.simulate_sources("low", rng).items()}
    results = _identify_all(synthetic, ("atm1:2", "atm1:3", "atm1:4", "atm2:2", "atm2:3"), effort)
    panels = {name: {t: ("low", w, law) for w, t in SOURCE_TITLES.items()} for name, law in ORDERS.items()}
    drawn = [_traces(name, results, keys) for name, keys in panels.items()]
    return sections.section("orders", [_table_orders(results)], drawn, *_claims_orders(results))


def equation_4(effort: sections.Effort = sections.FULL, seed: int = 0) -> sections.Section:
    """Compare Eq. 4 as printed with Eq. 4 with t in every sum, on recordings of either.

    Parameters
    ----------
    effort, seed
        As in `two_models`.

    Returns
    -------
    Section
        Tables, figure and claim.

    """
    rng = np.random.default_rng([seed, 4])
    synthetic = {}
    for group, source in laws.ATM2.items():
        law, speed = laws.to_effects("atm2_printed:2", laws.read_as_printed(source)), source.speed or 0.0
        synthetic[group, "as printed"] = method.record_law(*law, method.BEAM, speed, rng)
        synthetic[group, "with t"] = method.record_printed(source, method.TIME_UNITS["ATM2"], method.BEAM, rng)
    results = _identify_all(synthetic, ("atm2_printed:2", "atm2:2"), effort)
    kept = {key: float(1 - r.truth.v[-1] / r.truth.v[0]) for key, r in synthetic.items()}
    rows, told = list[list[Any]](), []
    for group, source in laws.ATM2.items():
        sliding, viscous = (np.sin(half[::2] + half[1::2]).sum() for half in np.split(np.array(source.values[4:]), 2))
        f_c, f_s, f_v, _ = source.values[:4]
        braked = [100 * kept[group, reading] for reading in ("as printed", "with t")]
        rows.append([group, sliding, viscous, f_s - sliding * f_c, f_v * viscous, *braked])
        lost = f"speed lost {braked[0]:.0f} % (with t {braked[1]:.0f} %)"
        told.append(f"{group}: sums {sliding:.2f} and {viscous:.2f}, {lost}")
    readings = {"as printed": "atm2_printed:2", "with t": "atm2:2"}
    panels = {
        title: _curves({label: results[group, "as printed", law].chosen for label, law in readings.items()})
        for group, title in method.GROUPS.items()
    }
    return sections.section(
        "equation_4",
        [sections.table("equation_4", rows), _table_errors("equation_4_errors", results)],
        [sections.figure("equation_4", figures.traces, panels)],
        sections.claim("equation_4", None, "; ".join(told)),
    )


def _identify_all(synthetic: Recordings, names: tuple[str, ...], effort: sections.Effort) -> Identified:
    """Identify laws on recordings, each by the papers' method."""
    results = {}
    for (group, source), recording in synthetic.items():
        run = method.friction_run(replace(recording.run, name=laws.RUN))
        for name in names:
            results[group, source, name] = method.identify(name, run, effort)
    return results


def _traces(name: str, results: Identified, panels: Mapping[str, Key]) -> dict[str, Any]:
    """Draw both fits of an identification in each panel of a figure."""
    return sections.figure(name, figures.traces, {title: _curves(results[key].fits) for title, key in panels.items()})


def _curves(fits: Mapping[str, Fit]) -> tuple[Run, dict[str, Array]]:
    """The run of some fits, and the friction of each along it."""
    return next(iter(fits.values())).runs[0], {label: one.curves[0].F_model for label, one in fits.items()}


def _table_errors(name: str, results: Identified) -> sections.ResultTable:
    rows: list[list[Any]] = []
    for (group, source, law), found in results.items():
        said = (laws.ATM1 if law == "atm1:2" else laws.ATM2)[group].error
        errors = float(found.errors.min()), float(np.median(found.errors)), found.lowest
        model = {"atm1:2": "ATM1", "atm2:2": "ATM2"}.get(law, "ATM2 as printed")
        rms = float(np.sqrt(found.lowest / len(found.data[0])))
        rows.append([group, SOURCE_TITLES.get(source, source), model, said, *errors, rms])
    return sections.table(name, rows)


def _tables_parameters(results: Identified, synthetic: Recordings) -> list[sections.ResultTable]:
    """Tables 1-4: printed (and simulated) parameters, those of MGA, and those of frictrack."""
    out = []
    for name, kind, sources in (("atm1:2", "ATM1", laws.ATM1), ("atm2:2", "ATM2", laws.ATM2)):
        for group, source in sources.items():
            found = results[group, f"{kind} tables", name]
            truth = laws.read_printed(source, method.TIME_UNITS[kind])
            fitted = method.fit_with_frictrack(name, synthetic[group, f"{kind} tables"].run)
            ours = np.full(len(truth), np.nan) if fitted is None else method.parameters_of(name, fitted)
            addresses = np.array(list(laws.addresses(name).values()))[_order_of_sines(ours, truth, name)]
            estimates = [method.estimate_text(fitted, str(address)) for address in addresses]
            chosen = found.parameters[_order_of_sines(found.parameters, truth, name)]
            columns = laws.addresses(name), source.values, truth, chosen, estimates
            out.append(sections.table(source.where.lower().replace(" ", ""), list(zip(*columns, strict=True))))
    return out


def _order_of_sines(p: Array, truth: Array, name: str) -> NDArray[np.intp]:
    """Positions of an ATM1 law's parameters (d,) that put its sines in the order of the true frequencies."""
    order: NDArray[np.intp] = np.arange(len(p))
    if name.startswith("atm1"):
        ranks = np.argsort(np.argsort(truth[5::3]))
        order[4:] = order[4:].reshape(-1, 3)[np.argsort(p[5::3])][ranks].ravel()
    return order


def _claims_models(results: Identified, effort: sections.Effort) -> Claims:
    pairs = [(g, w) for g in method.GROUPS for w in SOURCE_TITLES]
    ratios = {(g, w): results[g, w, "atm2:2"].lowest / results[g, w, "atm1:2"].lowest for g, w in pairs}
    missed = {
        f"{name[:4].upper()} {g}": int(np.sum(found.errors > 1.2 * found.lowest))
        for (g, w, name), found in results.items()
        if w == ("ATM1 tables" if name == "atm1:2" else "ATM2 tables")
    }
    better = [k for k, r in ratios.items() if r < 1]
    told = "; ".join(f"{g}, {SOURCE_TITLES[w]} {r:.2f}" for (g, w), r in ratios.items())
    said: dict[str, Any] = {g: (laws.ATM2[g].error or 0) / (laws.ATM1[g].error or 1) for g in method.GROUPS}
    counts = "; ".join(f"{name}: {n} of {effort.identified}" for name, n in missed.items())
    found = None if effort.identified < 5 else not any(missed.values())
    return (
        sections.claim("atm2_better", len(better) == len(ratios), told, fails=not better, **said),
        sections.claim("mga_identifies", found, f"error above 1.2 times the lowest known: {counts}"),
    )


def _table_orders(results: Identified) -> sections.ResultTable:
    rows: list[list[Any]] = []
    for (group, source, name), found in results.items():
        kind, _, n = name.partition(":")
        base, gain = results[group, source, f"{kind}:2"], _gain(results, source, name)
        by_search = 100 * float(np.median(base.errors) / np.median(found.errors) - 1)
        said = {"atm1:3": 100 * laws.GAIN_ATM1, "atm2:3": 100 * laws.GAIN_ATM2}.get(name)
        gains = [None] * 3 if n == "2" else [said, gain, by_search]
        size = float(n), float(len(laws.addresses(name)))
        rows.append([SOURCE_TITLES[source], kind.upper(), *size, found.lowest, *gains])
    return sections.table("orders", rows)


def _gain(results: Identified, source: str, law: str) -> float:
    """Relative fall of the error, %, from the law with two sines to another one, at low speed."""
    return 100 * (results["low", source, f"{law[:4]}:2"].lowest / results["low", source, law].lowest - 1)


def _claims_orders(results: Identified) -> Claims:
    gains = {kind: {w: _gain(results, w, f"{kind}:3") for w in SOURCE_TITLES} for kind in ("atm1", "atm2")}
    told = {k: "; ".join(f"{SOURCE_TITLES[w]} {g:+.0f} %" for w, g in each.items()) for k, each in gains.items()}
    more = [gains["atm2"][w] > gains["atm1"][w] for w in SOURCE_TITLES]
    near = [4 < g < 20 for g in gains["atm1"].values()]
    large = [g >= 300 for g in gains["atm2"].values()]
    share = f"so on {sum(more)} of {len(more)} kinds of recording"
    return (
        sections.claim("third_sine", all(near), told["atm1"], fails=not any(near)),
        sections.claim("third_order", all(large), told["atm2"], fails=not any(large)),
        sections.claim("atm2_gains_more", all(more), share, fails=not any(more)),
    )


TIME_UNIT = "millisecond"  # per sample, 2.86 of Table 2 would be 1.8 kHz; per second, no sine completes a cycle


def sine_filter(effort: sections.Effort = sections.FULL, seed: int = 0) -> sections.Section:
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
    measured = recording.truth.a + method.SENSOR_NOISE * rng.standard_normal(len(recording.truth.t))
    run = method.friction_run(replace(recording.run, name=laws.RUN), measured)
    results = {name: method.identify(name, run, effort, "sga") for name in ("tustin", "atm1:2")}
    bounded = laws.tustin_below(*np.array(laws.WITHOUT_FILTER.values)[[0, 2]])
    rounded = method.identify("tustin", run, effort, "sga", bounded).over_seeds
    own = {name: method.fit_with_frictrack(name, recording.run) for name in results}
    traces = {what: _curves({"SGA": results[law].chosen}) for what, law in (("without", "tustin"), ("with", "atm1:2"))}
    strong, weak = 1e6 * truth[4::3] / method.STRUCK.mass / (2 * np.pi * truth[5::3]) ** 2  # F/(m omega^2), um
    return sections.section(
        "sine_filter",
        [_table_static(results, rounded, own, truth), _table_sines(results["atm1:2"], truth)],
        [
            sections.figure("second_fig04_05_motion", figures.motions, {"struck with 2 J": [recording]}),
            sections.figure("second_fig06_07_friction", partial(figures.traces, as_force=True), traces),
        ],
        *_claims(results, rounded, own, truth),
        mass=method.STRUCK.mass,
        speed=recording.truth.v[0],
        noise=method.SENSOR_NOISE,
        strong=strong,
        weak=weak,
    )


def _table_static(results: Identified, rounded: Array, own: dict[str, Any], truth: Array) -> sections.ResultTable:
    without, full = results["tustin"], results["atm1:2"]
    rows: list[list[Any]] = []
    for i, (name, address) in enumerate(laws.STATIC.items()):
        left = float(without.parameters[i]), method.range_over_seeds(without, i), float(np.median(rounded[:, i]))
        right = float(full.parameters[i]), method.range_over_seeds(full, i)
        ours = {law: method.estimate_text(found, address) for law, found in own.items()}
        rows.append([name, laws.WITHOUT_FILTER.values[i], *left, ours["tustin"], truth[i], *right, ours["atm1:2"]])
    return sections.table("second_tables_1_2", rows)


def _table_sines(found: method.Identification, truth: Array) -> sections.ResultTable:
    names, printed = list(laws.addresses("atm1:2")), laws.WITH_FILTER.values
    rows = [
        [names[i], printed[i], truth[i], float(found.parameters[i]), method.range_over_seeds(found, i)]
        for i in range(4, len(truth))
    ]
    return sections.table("second_table_2_sines", rows)


def _claims(results: Identified, rounded: Array, own: dict[str, Any], truth: Array) -> Claims:
    without, full = results["tustin"], results["atm1:2"]
    t, v, force = full.data
    rest = force - method.law_force(*laws.to_effects("atm1:2", truth), v, t)
    floor = float(rest @ rest) / method.STRUCK.mass**2
    far = {name: np.abs(result.over_seeds[:, :4] / truth[:4] - 1) for name, result in results.items()}
    median = {name: float(np.median(x.mean(axis=1))) for name, x in far.items()}
    at_edge = np.abs(rounded[:, [0, 2]] / np.array(laws.WITHOUT_FILTER.values)[[0, 2]] - 1) < 1e-3
    fitted = own["atm1:2"]
    lost = [n for n, address in laws.STATIC.items() if fitted is None or fitted.parameters[address].value is None]
    missing = f" The recording does not hold {', '.join(lost)}: our fit says so, a search prints a number."
    better = median["atm1:2"] < median["tustin"]
    errors = f"lowest error {without.lowest:.3g} without, {full.lowest:.3g} with (m/s²)²"
    errors = f"{errors}; the rendered law itself leaves {floor:.3g}"
    relative = f"{100 * median['tustin']:.0f} % without, {100 * median['atm1:2']:.0f} % with"
    edges = f"F_c ends at the bound in {int(at_edge[:, 0].sum())} and F_v in {int(at_edge[:, 1].sum())}"
    return (
        sections.claim("filter_follows", without.lowest / full.lowest > 1.05, errors),
        sections.claim(
            "filter_precision",
            better and median["atm1:2"] < 0.1,
            f"mean relative error of the four, median over seeds: {relative}",
            fails=not better,
            missing=missing if lost else "",
        ),
        sections.claim("round_numbers", None, f"in a box that ends there, {edges} of {len(rounded)} runs"),
    )
