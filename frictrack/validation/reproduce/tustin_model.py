"""First paper, section 3.1: find the time unit of the printed frequencies, and identify the Tustin model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.fit import fit
from frictrack.records import Array
from frictrack.validation.reproduce import figures, laws, papers_method, printed, recordings
from frictrack.validation.reproduce.laws import PaperLaw
from frictrack.validation.reproduce.papers_method import (
    GROUPS,
    Identification,
    estimate_text,
    identify,
    range_over_seeds,
)
from frictrack.validation.reproduce.recordings import BEAM, SyntheticRecording
from frictrack.validation.reproduce.sections import (
    FULL,
    Claim,
    Effort,
    Progress,
    Section,
    claim,
    figure,
    section,
    silent,
    verdict,
)
from frictrack.validation.reproduce.sections import table as make_table

SPEEDS = {"low": (4.0, 4.5, 5.0), "high": (7.0, 7.5, 8.0)}  # m/s, section 3.1
DITHER_SHARE = 0.1  # of the printed sines, which are several times the friction that they would dither about
MIN_STRAIGHTNESS = 0.99  # share of a law's variation that a straight line in v explains: then it is one


def time_units() -> Section:
    """Test which time unit behind the printed "rad/s" gives curves as the papers describe them.

    Returns
    -------
    Section
        Table and claims.

    """
    rows: list[list[Any]] = []
    fits: dict[str, list[str]] = {}
    for source in (*printed.ATM1.values(), *printed.ATM2.values(), printed.WITH_FILTER):
        bench = recordings.STRUCK if source is printed.WITH_FILTER else BEAM
        for unit in laws.UNITS:
            curve = recordings.describe_curve(source, unit, bench)
            numbers = [float(curve[key]) for key in ("lowest_Hz", "highest_Hz", "cycles", "duration_ms")]
            motion = [100 * float(curve["braked"]), float(curve["mean_force_N"])]
            rows.append([source.where, unit, *numbers, *motion, "yes" if curve["described"] else "no"])
            if curve["described"]:
                fits.setdefault(source.where, []).append(unit)
    without = [s.where for s in printed.ATM2.values() if s.where not in fits]
    units = "; ".join(f"{where}: per {' or '.join(units)}" for where, units in fits.items()) + "; others: none"
    never = f"no time unit gives a dither and a brake together for {' and '.join(without) or 'any'}"
    limits = {"slowest": recordings.MIN_SPEED, "longest": recordings.MAX_DURATION_S}
    claims = claim("time_units", verdict(False), units), claim("atm2_brakes", verdict(not without), never)
    return section("time_units", [make_table("time_units", rows, **limits)], [], *claims)


def tustin_groups(effort: Effort = FULL, seed: int = 0, progress: Progress = silent) -> Section:
    """Reproduce Figs. 4-8: identify the Tustin model on the low-speed and on the high-speed group.

    Parameters
    ----------
    effort
        Seeds and evaluations.
    seed
        Seed of the recordings.
    progress
        Called with steps done, all steps and a text.

    Returns
    -------
    Section
        Table, figures and claims.

    """
    rng, law = np.random.default_rng([seed, 31]), laws.tustin()
    synthetic: dict[str, list[SyntheticRecording]] = {}
    results: dict[str, Identification] = {}
    for i, (group, speeds) in enumerate(SPEEDS.items()):
        progress(i, 3, f"Tustin model, {group} speed")
        laid = printed.TM[group], printed.ATM1[group]
        synthetic[group] = [recordings.record_with_dither(*laid, DITHER_SHARE, v, rng) for v in speeds]
        results[group] = identify(law, papers_method.measure_series([r.run for r in synthetic[group]]), effort, rng)
    progress(2, 3, "Tustin model, ours")
    runs = [run for group, made in synthetic.items() for run in recordings.group_runs(made, group)]
    try:
        ours, reason = dict(fit("tustin", runs, per="group").fits), ""
    except FrictrackError as e:
        ours, reason = {}, str(e)
    single = {g: papers_method.measure_series([made[-1].run]) for g, made in synthetic.items()}
    own = {g: Identification(law, single[g], (results[g].chosen,), results[g].chosen) for g in results}
    moved = {f"{group} speed": made for group, made in synthetic.items()}
    traced = {GROUPS[g]: (single[g], [("Tustin, MGA", d.acceleration(d.chosen))]) for g, d in own.items()}
    over_speed = {GROUPS[g]: (found.data, _force_curves(law, found, g)) for g, found in results.items()}
    rows = [
        [g, name, said, found.chosen[i], range_over_seeds(found, i), estimate_text(ours.get(g), name)]
        for g, found in results.items()
        for i, (name, said) in enumerate(zip(law.names, printed.TM[g].values, strict=True))
    ]
    return section(
        "tustin_groups",
        [make_table("tustin_groups", rows, reason=reason and f" Ours: {reason}.")],
        [
            figure("fig08_accelerations", figures.motions, moved),
            figure("fig06_07_tustin", figures.traces, traced),
            figure("tustin_over_speed", figures.forces, over_speed),
        ],
        *_claims_tustin(law, results, ours, reason),
    )


def _force_curves(law: PaperLaw, found: Identification, group: str) -> list[tuple[str, Array, Array]]:
    v = np.linspace(found.data.v.min(), found.data.v.max(), 200)
    both = {"Tustin, MGA": found.chosen, "rendered, without sines": np.array(printed.TM[group].values)}
    return [(label, v, law.force(p[None], v, v)[0]) for label, p in both.items()]


def straightness(law: PaperLaw, p: Array, v: Array) -> float:
    """Share of a law's variation over measured speeds that a straight line in v explains.

    Parameters
    ----------
    law, p
        The law and its parameters, (d,).
    v
        Speeds, m/s, (n,).

    Returns
    -------
    float
        Share, at most 1.

    """
    force = law.force(p[None], v, v)[0]
    rest = force - np.polyval(np.polyfit(v, force, 1), v)
    return float(1 - rest.var() / max(force.var(), 1e-30))


def _claims_tustin(
    law: PaperLaw, results: Mapping[str, Identification], ours: Mapping[str, Any], reason: str
) -> tuple[Claim, ...]:
    straight = {g: straightness(law, d.chosen, d.data.v) for g, d in results.items()}
    left = {g: d.lowest / float(np.sum((d.data.a - d.data.a.mean()) ** 2)) for g, d in results.items()}
    undetermined = [g for g in results if g in ours and ours[g].parameters["stribeck.v_s"].value is None]
    dithers = "; ".join(
        f"{100 * share:.0f} % of the acceleration's variance is left ({g})" for g, share in left.items()
    )
    lines = "; ".join(
        f"{g}: {100 * s:.2f} % straight, slowest {results[g].data.v.min():.1f} m/s" for g, s in straight.items()
    )
    stated = ", ".join(f"{d.chosen[1]:.3g} N ({g}, rendered {printed.TM[g].values[1]:.3g})" for g, d in results.items())
    known = f"not determined in {' and '.join(undetermined)}" if undetermined else "determined"
    return (
        claim("tustin_unsuitable", verdict(min(left.values()) > 0.1), dithers),
        claim("tustin_straight", verdict(straight["high"] > MIN_STRAIGHTNESS), lines),
        claim(
            "tustin_groups",
            verdict("high" not in undetermined and not reason, False),
            f"MGA puts F_s at {stated}; ours: {known}",
            change=100 * (printed.TM["high"].values[1] / printed.TM["low"].values[1] - 1),
        ),
    )
