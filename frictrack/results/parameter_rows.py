"""The parameters of a fit as rows of text: one wording for the terminal, the report and the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from frictrack.base.number_format import format_interval, format_quantity, format_size, format_unit, prefixed


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
