"""The errors of fitted models as rows: one list, in one order, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from frictrack.base.number_format import format_interval, format_number, format_share


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

    """
    found = list(models)
    return [
        ErrorRow(name, unit, short, tuple(None if e.get(key) is None else factor * e[key] for e in found))
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
    if errors.get("heldout_rms_um") is not None:
        return errors["heldout_rms_um"], "µm"
    return errors.get("heldout_rms_N"), "N"


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
