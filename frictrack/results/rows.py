"""Names of models and axes, and rows of tables of results, in one wording for terminal, page and report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from frictrack.base.number_format import (
    describe_change,
    format_interval,
    format_number,
    format_quantity,
    format_share,
    format_size,
    format_unit,
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
