"""The rows of tables that people see: parameters, errors, spans, runs, and the one list of candidates.

Effects that were found come first, in the order found; each was tested in addition to those before it, and its rivals,
which predict the same data, follow it. Then come the effects that pass alone, then the others, both by their evidence.
The criterion is delta BIC throughout. A candidate without positive evidence is not listed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from frictrack.base.number_format import (
    describe_change,
    format_change,
    format_interval,
    format_number,
    format_p_value,
    format_quantity,
    format_share,
    format_size,
    format_unit,
    join_words,
    prefixed,
)


class ErrorRow(NamedTuple):
    """One kind of error, and its values of several models.

    Attributes
    ----------
    name, unit : str
        What it is; "" for a number without unit.
    short : str
        Its head in a narrow table; "" for what only the report shows.
    values : tuple of float or None
        One value per model, in `unit`; None if it is not known.

    """

    name: str
    unit: str
    short: str
    values: tuple[float | None, ...]


MIN_P_STATED = 1e-6
_KINDS = (
    ("rms_displacement_um", "displacement, rms", "µm", "x", 1.0),
    ("rms_N", "friction force, rms", "N", "F", 1.0),
    ("noise_N", "noise of the measured force", "N", "noise", 1.0),
    ("heldout_rms_um", "held out, rms", "µm", "held out", 1.0),
    ("heldout_rms_N", "held out, rms", "N", "held out", 1.0),
    ("free_run_rms_um", "free run, rms", "µm", "free run", 1.0),
    ("free_run_relative", "free run, relative", "%", "", 100.0),
    ("rms_acceleration", "acceleration, rms", "m/s²", "a", 1.0),
    ("sse_acceleration", "acceleration, sum of squares", "m²/s⁴", "", 1.0),
    ("relative_force_error", "relative force error", "%", "force", 100.0),
    ("reduced_chi2", "reduced chi²", "", "chi²", 1.0),
)  # key of a fit's `errors`, name, unit, short head, factor


def error_rows(models: Iterable[Mapping[str, Any]]) -> list[ErrorRow]:
    """Return the errors that any of the models has.

    Parameters
    ----------
    models : iterable of mappings
        The `errors` in the JSON of each fit.

    Examples
    --------
    >>> error_rows([{"relative_force_error": 0.02}])
    [ErrorRow(name='relative force error', unit='%', short='force', values=(2.0,))]
    >>> error_rows([{"rms_displacement_um": 1.0, "relative_force_error": 0.02}])[1].name
    'filtered force error'

    """
    found = list(models)
    names = {"relative force error": "filtered force error"} if any(e.get("rms_displacement_um") for e in found) else {}
    return [
        ErrorRow(names.get(name, name), unit, short, tuple(e.get(key) and factor * e[key] for e in found))
        for key, name, unit, short, factor in _KINDS
        if any(e.get(key) is not None for e in found)
    ]


def held_out_error(errors: Mapping[str, Any]) -> tuple[float | None, str]:
    """Select the held-out error of a fit and its unit.

    Examples
    --------
    >>> held_out_error({"heldout_rms_um": None, "heldout_rms_N": 0.02})
    (0.02, 'N')

    """
    micrometres, newtons = errors.get("heldout_rms_um"), errors.get("heldout_rms_N")
    return (newtons, "N") if micrometres is None else (micrometres, "µm")


def describe_held_out(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Describe how the held-out error differs between the errors of two fits.

    Examples
    --------
    >>> describe_held_out({"heldout_rms_um": 2.644}, {"heldout_rms_um": 0.7012})
    'the held-out error falls from 2.64 to 0.701 µm'

    """
    (old, unit), (new, _) = held_out_error(before), held_out_error(after)
    return f"the held-out error {describe_change(old, new, unit)}"


FAILING_HEADS = ("t / ms", "x / m", "v / (m/s)", "share of the misfit", "p")  # after the run


def failing_rows(spans: Iterable[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return where a model fails, one row per span: the run, then the columns of `FAILING_HEADS`.

    Examples
    --------
    >>> failing_rows([{"run": "slow", "t": [0.02, 0.03], "share_of_error": 0.4, "p": 1e-9}])
    [('slow', '20.0 to 30.0', '–', '–', '40 %', '< 10⁻⁶')]

    """
    rows = []
    for s in spans:
        places = (format_interval(s.get(key), factor) for key, factor in (("t", 1e3), ("x", 1.0), ("v", 1.0)))
        p = s.get("p")  # the distribution of the noise is not known far out: smaller ones get no digits
        chance = "< 10⁻⁶" if p is not None and p < MIN_P_STATED else format_number(p, 1)
        rows.append((s["run"], *places, format_share(s["share_of_error"]), chance))
    return rows


MIN_SIGMAS_LOCKING = 3.0  # standard deviations from which peak locking counts as found
MEASUREMENT_HEADS = ("σ / px", "σ / µm", "score", "locking / px", "back / px", "fixed / px", "shake / px", "blur / px",
                     "exposure / µs")  # fmt: skip


def measurement_cells(found: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the columns of `MEASUREMENT_HEADS` of a film: deviation, match score, peak locking, and others.

    Examples
    --------
    >>> found = {"sigma_px": 0.0014, "score": 0.999, "peak_locking_px": 0.005, "peak_locking_std_px": 0.003}
    >>> measurement_cells(found)[:4]
    ('0.0014', '–', '0.999', 'none')

    """
    locking, std, shake = found.get("peak_locking_px"), found.get("peak_locking_std_px"), found.get("shake_px")
    is_locked = locking is not None and std is not None and locking > MIN_SIGMAS_LOCKING * std
    return (
        *(format_number(found.get(key), 2) for key in ("sigma_px", "sigma_um")),
        format_number(found.get("score")),
        format_quantity(locking, std, "") if is_locked else format_number(None) if locking is None else "none",
        *(format_number(found.get(key), 2) for key in ("forward_backward_px", "noise_floor_px")),
        "none" if shake == 0 else format_number(shake, 2),
        format_number(found.get("blur_px"), 2),
        format_number(1e6 * found["exposure_s"] if found.get("exposure_s") else None),
    )


class ParameterRow(NamedTuple):
    """One parameter; what is not known is "".

    Attributes
    ----------
    value : str
        Value ± standard deviation, with its unit.
    short : str
        The same with one ± that includes the misfit of a model that fails; it is marked with a dagger.
    misfit : str
        Standard deviation that includes the misfit.
    interval : str
        95 % interval.
    from_prior : str
        Share of the precision that comes from a prior.
    remark : str
        Why the parameter is fixed or not determined; else its coefficient of friction.

    """

    value: str
    short: str
    misfit: str
    interval: str
    from_prior: str
    remark: str

    @property
    def short_remark(self) -> str:
        """The remark as far as it fits into a line; what settles a parameter is left out."""
        return self.remark.split(";")[0].split(":")[0]


def parameter_row(p: Mapping[str, Any]) -> ParameterRow:
    """Describe one entry of `parameters` in the JSON of a fit.

    Examples
    --------
    >>> row = parameter_row({"value": 0.0079, "std": 0.00026, "std_misfit": 0.0013, "unit": "m"})
    >>> row.value, row.short, row.misfit
    ('7.9 ± 0.3 mm', '7.9 ± 1.3 mm †', '1.3 mm')
    >>> parameter_row({"value": 1.0, "std": None, "unit": "1", "reason": "fixed", "interval": [0.5, None]}).interval
    'above 0.5000'

    """
    unit, std, wide = p["unit"], p["std"], p.get("std_misfit")
    return ParameterRow(
        value=format_quantity(p["value"], std, unit),
        short=format_quantity(p["value"], std if wide is None else wide, unit) + " †" * (wide is not None),
        misfit="" if wide is None else format_size(wide, unit),
        interval=interval_with_unit(p["interval"], unit) if "interval" in p else "",
        from_prior=f"{100 * p['from_prior']:.0f} %" if "from_prior" in p else "",
        remark=_remark(p),
    )


def interval_with_unit(ends: Sequence[float | None] | None, unit: str) -> str:
    """Format a 95 % interval with its unit; either end may be open.

    Examples
    --------
    >>> interval_with_unit((0.00757, 0.0083), "m"), interval_with_unit((None, None), "N")
    ('7.570 to 8.300 mm', 'any')

    """
    known = [abs(end) for end in ends or () if end is not None]
    factor, unit = prefixed(max(known), unit) if known else (1.0, "")
    return f"{format_interval(ends, factor, 4)} {format_unit(unit)}".strip()


def _remark(p: Mapping[str, Any]) -> str:
    if p.get("reason"):
        return str(p["reason"])
    if p.get("at_bound"):
        return "at its bound: the true value may lie beyond"
    mu = p.get("mu")
    return "" if mu is None else f"µ = {format_quantity(mu['value'], mu['std'], '1')}"


TUSTIN = ("coulomb", "stribeck", "viscous")  # the effects that together are the Tustin model
_CAPITALISED = {"tustin": "Tustin", "coulomb": "Coulomb", "stribeck": "Stribeck", "stribeck-model": "Stribeck model"}


def plain_name(group: str) -> str:
    """Convert the name of a stored model to words.

    Parameters
    ----------
    group : str
        Name of the model's group in the results: its number in the history, an underscore, its parts.

    Examples
    --------
    >>> plain_name("2_tustin+texture")
    'Tustin + texture'

    """
    return joined_name(group.split("_", 1)[-1].split("+"))


def joined_name(effects: Sequence[str]) -> str:
    """Convert the effects of a model to words.

    Parameters
    ----------
    effects : sequence of str
        Names of effects or models.

    Examples
    --------
    >>> joined_name(["coulomb", "stribeck", "viscous", "patch"]), joined_name(["coulomb", "drag"])
    ('Tustin + patch', 'Coulomb + drag')

    """
    parts = list(effects)
    if set(TUSTIN) <= set(parts):
        parts = ["tustin", *(part for part in parts if part not in TUSTIN)]
    return " + ".join(_CAPITALISED.get(part, part.upper() if part.startswith("atm") else part) for part in parts)


def numbered_name(group: str) -> str:
    """Convert the name of a stored model to words, with its number in the history.

    Examples
    --------
    >>> numbered_name("2_tustin+texture")
    '2. Tustin + texture'

    """
    return f"{group.split('_', 1)[0]}. {plain_name(group)}"


@dataclass(frozen=True)
class MotionAxis:
    """The texts of one axis.

    Attributes
    ----------
    name : str
        Name in a sentence.
    label : str
        Label of the axis in a figure.
    unit : str
        SI unit.

    """

    name: str
    label: str
    unit: str


AXES = {
    "t": MotionAxis("time since release", "time since release t", "s"),
    "x": MotionAxis("place", "displacement x", "m"),
    "v": MotionAxis("speed", "speed |v|", "m/s"),
    "a": MotionAxis("acceleration", "acceleration along the motion", "m/s^2"),
    "phase": MotionAxis("phase", "phase", "cycles"),
}


MAX_P = 0.005  # half of alpha = 0.01, the half that the candidates get
STANDINGS = {  # the words of every kind of candidate, for all that people read
    "named": "found",
    "lead": "explains a part",
    "rival": "predicts the same data as {}",
    "weaker": "passes alone",
    "less": "explains less than {}",
    "unconfirmed": "not confirmed by its fit",
    "fails": "not significant",
    "implausible": "not plausible: {}",
}
MAIN_KINDS = ("named", "rival", "lead")
ACTS_ON = {"force": "a force on the mass", "measurement": "an error of the measurement"}


@dataclass(frozen=True)
class CandidateRow:
    """One candidate.

    Attributes
    ----------
    effect : str
        Name of the effect.
    kind : {"named", "lead", "rival", "weaker", "fails", "implausible"}
        Found; explains a part of a misfit that nothing explains; predicts the same data as one that was found; passes
        with less evidence; explains less or is not significant; fits but is not plausible.
    standing : str
        The same in words, with what it was tested in addition to.
    delta_bic : float
        Evidence, above zero; positive means better with the effect.
    p : str
        p-value of the whole search, "at most 1/1000" where no simulated study reached the evidence.
    before, after, unit : float or None, float or None, str
        Held-out error without and with the effect, and its unit.
    added_to : tuple of str
        Effects found before, in addition to which it was tested.
    parameters : tuple of str
        Values that all runs share, with units.
    share : str
        Share of the misfit that it explains alone; "" if it is not known.
    source : mapping
        The candidate in the JSON of the diagnosis; its `words` say what it is, what it looks like, where it shows here,
        and how to confirm it.
    together : str
        The held-out error with the effects found after it, where it rises with this one alone; else "".

    """

    effect: str
    kind: str
    standing: str
    delta_bic: float
    p: str
    before: float | None
    after: float | None
    unit: str
    parameters: tuple[str, ...]
    added_to: tuple[str, ...]
    share: str
    source: Mapping[str, Any]
    together: str = ""

    @property
    def passes(self) -> bool:
        """Whether it is significant, improves the BIC, and is plausible."""
        return self.kind not in ("fails", "implausible")

    @property
    def evidence(self) -> str:
        """The p-value and delta BIC in words."""
        return f"p {self.p}, delta BIC {format_change(self.delta_bic)}"

    @property
    def numbers(self) -> list[str]:
        """The evidence, and the held-out error with what was held out."""
        how = " (whole runs)" if self.source.get("heldout") == "run" else ""
        return [self.evidence, *([f"{self.error}{how}"] if self.error else [])]

    @property
    def line(self) -> str:
        """Its parameters and numbers in one line."""
        return "; ".join(filter(None, (", ".join(self.parameters), self.evidence, self.error)))

    @property
    def error(self) -> str:
        """The held-out error in words, of frames where runs cannot be left out; "" if nothing was held out."""
        how = " (every other frame)" if self.source.get("heldout") == "frames" else ""
        return f"held-out error {self.held_out}{how}" if self.held_out else ""

    @property
    def rivals(self) -> list[str]:
        """Effects that these runs cannot distinguish from it."""
        return list(self.source["indistinguishable_from"]) if self.passes else []

    @property
    def acts_on(self) -> str:
        """Whether it is a force or an error of the measurement."""
        return ACTS_ON.get(self.source["acts_on"], "")

    @property
    def held_out(self) -> str:
        """Held-out error without and with it; "" if nothing was held out."""
        both = f"{format_number(self.before)} to {format_number(self.after)} {self.unit}{self.together}"
        return "" if self.before is None or self.after is None else both


def candidate_rows(diagnosis: Mapping[str, Any] | None) -> list[CandidateRow]:
    """List the candidates of a diagnosis, the best first.

    Parameters
    ----------
    diagnosis : mapping or None
        The JSON of a diagnosis; None before one was made.

    Examples
    --------
    >>> patch = {"effect": "patch", "p": 0.001, "delta_bic": 300.0, "passes": True, "indistinguishable_from": []}
    >>> drag = patch | {"effect": "drag", "delta_bic": 40.0}
    >>> for row in candidate_rows({"candidates": [drag, patch], "missing": ["patch", "drag"]}):
    ...     print(row.effect, "-", row.standing, "-", row.evidence)
    patch - found - p at most 1/1000, delta BIC +300
    drag - found in addition to patch - p at most 1/1000, delta BIC +40

    """
    if diagnosis is None:
        return []
    shares = {row["effect"]: row["explained_alone"] for row in diagnosis.get("importance") or []}
    by_name = {c["effect"]: c | {"share": shares.get(c["effect"])} for c in diagnosis["candidates"]}
    leads = diagnosis.get("leads") or []
    found = [name for name in (diagnosis.get("missing") or leads) if name in by_name]
    rows: dict[str, CandidateRow] = {}
    error = None  # held-out error with the effects found so far
    for k, name in enumerate(found):
        kind = "lead" if name in leads else "named"
        rows[name] = _row(by_name[name], kind, STANDINGS[kind], error, found[:k])
        error = rows[name].after if rows[name].after is not None else error
        for rival in by_name[name].get("indistinguishable_from") or []:
            if rival in by_name and rival not in found:
                rows.setdefault(rival, _row(by_name[rival], "rival", STANDINGS["rival"].format(name)))
    for k, name in enumerate(found):
        rows[name] = replace(rows[name], together=_together(rows[name], [rows[later] for later in found[k + 1 :]]))
    best = max((c for c in by_name.values() if passes(c)), key=lambda c: c["delta_bic"], default=None)
    others = (_other(c, best) for name, c in by_name.items() if name not in rows)
    rest = sorted(others, key=lambda row: (_OTHER_KINDS.index(row.kind), -row.delta_bic))
    return [*rows.values(), *(row for row in rest if row.delta_bic > 0)]


def _together(row: CandidateRow, later: Sequence[CandidateRow]) -> str:
    """Say which of the effects found later lower a held-out error that rises with one of them alone."""
    if row.before is None or row.after is None or row.after <= row.before:
        return ""
    for k, one in enumerate(later, 1):
        if one.after is not None and one.after < row.before:
            names = join_words([other.effect for other in later[:k]])
            return f" alone, but {format_number(one.after)} {row.unit} with {names} as well"
    return ""


def not_passing(rows: Sequence[CandidateRow]) -> str:
    """Count the candidates with positive evidence that do not pass, in words; "" if there are none."""
    failing, implausible = (sum(row.kind == kind for row in rows) for kind in ("fails", "implausible"))
    words = "explains less or is" if failing == 1 else "explain less or are"
    parts = [f"{failing} {words} not significant"] if failing else []
    parts += [f"{implausible} {'is' if implausible == 1 else 'are'} not plausible"] if implausible else []
    return f"Of the others with some evidence, {' and '.join(parts)}." if parts else ""


def passes(candidate: Mapping[str, Any]) -> bool:
    """Whether a candidate is significant for the whole search, confirmed by its simulated fit, and plausible.

    Parameters
    ----------
    candidate : mapping
        A candidate of a diagnosis: `passes`; in results of older versions `p`, `delta_bic` and, where it is not
        plausible, `implausible`.

    Examples
    --------
    >>> passes({"p": 0.001, "delta_bic": 40.0}), passes({"p": 0.2, "delta_bic": 40.0})
    (True, False)

    """
    if "passes" in candidate:
        return bool(candidate["passes"])
    return bool(candidate["p"] < MAX_P and candidate["delta_bic"] > 0 and not candidate.get("implausible"))


_OTHER_KINDS = ("weaker", "fails", "implausible")


def _other(c: Mapping[str, Any], best: Mapping[str, Any] | None) -> CandidateRow:
    """Row of a candidate that was not found and predicts other data."""
    if c.get("implausible"):
        return _row(c, "implausible", STANDINGS["implausible"].format(c["implausible"]))
    behind = best["delta_bic"] - c["delta_bic"] if best else 0.0
    if not passes(c):
        key = "fails" if c["p"] >= MAX_P else "less" if behind > 0 else "unconfirmed"
        return _row(c, "fails", STANDINGS[key].format(best["effect"] if best else ""))
    how = f", {format_number(behind)} behind the best" if behind >= 1 else ", level with the best" if behind > 0 else ""
    return _row(c, "weaker", STANDINGS["weaker"] + how)


def _row(
    c: Mapping[str, Any], kind: str, standing: str, before: float | None = None, added_to: Sequence[str] = ()
) -> CandidateRow:
    """Row of a candidate; `before` is the held-out error without it, if others were added before it."""
    added = f" in addition to {join_words(added_to)}" if added_to else ""
    unit = "N" if c.get("heldout_rms_after_um") is None else "um"
    bare, after = (c.get(f"heldout_rms_{when}_{unit}") for when in ("before", "after"))
    fitted = {name: q for name, q in c.get("parameters", {}).items() if q["std"] != 0}  # no fixed ones
    shared = {name: q for name, q in fitted.items() if "[" not in name}
    own = sorted({name.partition("[")[0] for name in fitted if "[" in name})
    values = [f"{name} {format_quantity(q['value'], q['std'], q['unit'])}" for name, q in shared.items()]
    values += [f"one {' and one '.join(own)} per run"] if own else []
    if c["effect"].startswith("slope") and (here := c.get("words", {}).get("here")):
        values.append(here.partition(":")[0].lower())  # the incline is 0.4 degrees, not 0
    share = "" if c.get("share") is None else f"{100 * c['share']:.1f} %"
    return CandidateRow(
        c["effect"], kind, standing + added, c["delta_bic"], format_p_value(c["p"]),
        bare if before is None else before, after, unit.replace("u", "µ"), tuple(values), tuple(added_to), share, c,
    )  # fmt: skip
