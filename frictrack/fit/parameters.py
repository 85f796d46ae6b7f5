"""The parameter vector of a fit: its layout, constraints, friction levels of the runs, and an unknown mass.

The unknowns of a model over several runs form one vector p (P,). `ParameterLayout` maps it to the parameter values of
every run. The internal value of a parameter may differ from the reported one: F_s is fitted as its rise over F_c. Users
fix and tie reported values; here they are converted to internal ones.

Where the drive is measured, the mass may be unknown: 1/m is one more linear coefficient. The equation of motion is
written in units of a guessed mass m_ref:

    m_ref x'' = q D - q F + m_ref g,     q = m_ref/m,     g the gravity along the track, independent of the mass

So q - 1 multiplies the drive, and every force coefficient is fitted as q times itself. After the fit m_ref is set to
the fitted mass: then q = 1, and all values are in kilograms and newtons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from graphlib import TopologicalSorter
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError, UsageError
from frictrack.effects import Effect, Nonlinear, Parameter, Path, Span, Tie
from frictrack.effects.models import Model
from frictrack.records import Array, Mask, Run

MASS = "mass"  # pseudo-effect; its parameter is the unit of mass over the mass, minus one
Values = dict[str, dict[str, Any]]  # effect -> parameter -> value in one run; numbers, or arrays of a population
LEVEL = "level"  # pseudo-effect: the run's own factor on dry friction
MIN_RUNS_FOR_SCATTER = 4  # with fewer runs the scatter is not estimated; levels are free with mean one
MIN_MASS_RATIO = 1e-6  # q at the largest mass that is searched
PLACE_MARGIN = 0.1  # of the scanned places, by which a place may lie beyond them: most widths are below an eighth


@dataclass(frozen=True)
class Constraint:
    """One parameter that is not an unknown: its reported value, or the tie that it follows."""

    effect: Effect
    parameter: Parameter
    value: float | Tie

    @property
    def is_reported_differently(self) -> bool:
        """Whether the reported value differs from the internal one."""
        return self.parameter.name in self.effect.quoted


def constraints_of(model: Model) -> tuple[Constraint, ...]:
    """Collect the constraints of a model; a parameter follows only parameters before it, without circles."""
    found = []
    for e in model.effects:
        for p in e.parameters:
            if p.tie is not None:
                found.append(Constraint(e, p, Tie.read(p.tie)))
            elif p.fixed is not None and (p.name in e.quoted or (MASS in model and _is_force_coefficient(e, p))):
                found.append(Constraint(e, p, p.fixed))
    same = {(c.effect.name, c.parameter.name): c for c in found if not c.is_reported_differently}
    leaders = {key: [(c.value.effect, c.value.parameter)] for key, c in same.items() if isinstance(c.value, Tie)}
    order = TopologicalSorter({key: [at for at in leaders.get(key, []) if at in same] for key in same}).static_order()
    return (*(same[key] for key in order), *(c for c in found if c.is_reported_differently))


def apply_constraints(model: Model, constraints: tuple[Constraint, ...], values: Values) -> None:
    """Fill in the constrained values of one run, in place: internal ones, numbers or arrays (P,) of a population."""
    q = mass_unit_ratio(values)
    for c in constraints:
        target: Any = c.value
        if isinstance(target, Tie):
            target = target.factor * reported_value(model, values, target.effect, target.parameter)
        if c.is_reported_differently:
            target = _internal_value(model, c, target, values)
        values[c.effect.name][c.parameter.name] = target * q if _is_force_coefficient(c.effect, c.parameter) else target


def reported_value(model: Model, values: Values, effect: str, parameter: str) -> Any:
    """Compute the reported value of a parameter, in its unit, from the internal values of one run."""
    found = next(e for e in model.effects if e.name == effect)
    if parameter in found.quoted and found.quote is not None:
        return found.quote(*_values_in_newtons(model, values, found))[parameter]
    q = mass_unit_ratio(values) if _is_force_coefficient(found, found.parameter(parameter)) else 1.0
    return values[effect][parameter] / q


def mass_unit_ratio(values: Mapping[str, Mapping[str, Any]]) -> Any:
    """Compute q, the unit of mass over the mass. Forces are fitted as q times themselves; q is 1 for a known mass."""
    return 1.0 + values[MASS]["m"] if "m" in values.get(MASS, {}) else 1.0


def _values_in_newtons(model: Model, values: Values, effect: Effect) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of one effect by name and of all effects by address, forces in newtons."""
    q = mass_unit_ratio(values)
    known = {
        (e.name, p.name): values[e.name][p.name] / (q if _is_force_coefficient(e, p) else 1.0)
        for e in model.effects
        for p in e.parameters
        if p.name in values[e.name]
    }
    own = {name: value for (of, name), value in known.items() if of == effect.name}
    return own, {f"{of}.{name}": value for (of, name), value in known.items()}


def _is_force_coefficient(effect: Effect, p: Parameter) -> bool:
    return p.linear and effect.acts_on == "force" and effect.name != MASS


def _internal_value(model: Model, constraint: Constraint, target: Any, values: Values) -> Any:
    """Internal value at which the parameter is reported as `target`. Reported values are linear or reciprocal in it."""
    name, quote = constraint.parameter.name, constraint.effect.quote
    assert quote is not None
    own, known = _values_in_newtons(model, values, constraint.effect)
    one, two, three = (
        quote(own | {name: u}, known | {f"{constraint.effect.name}.{name}": u})[name] for u in (1.0, 2.0, 3.0)
    )
    if np.allclose(three - two, two - one, rtol=1e-9):
        return 1.0 + (target - one) / (two - one)
    return one / target


@dataclass(frozen=True)
class Slot:
    """One unknown: a parameter of an effect, shared by all runs (run is None) or of one run (its index)."""

    effect: str
    parameter: str
    run: int | None
    linear: bool
    bounds: tuple[float, float]
    unit: str

    def name(self, runs: Sequence[str]) -> str:
        """Return the address of the unknown: `vibration.frequency`, `vibration.phase[v3]`."""
        where = "" if self.run is None else f"[{runs[self.run]}]"
        return f"{self.effect}.{self.parameter}{where}"


@dataclass(frozen=True)
class ReportedPrior:
    """Prior knowledge of a parameter: mean and standard deviation of its reported value.

    `slot` is its position in the parameter vector, None if the reported value differs from the internal one.
    """

    address: str
    mean: float
    std: float
    slot: int | None
    phase: bool


@dataclass(frozen=True)
class ParameterLayout:
    """The unknowns of a model over some runs.

    Attributes
    ----------
    model : Model
        The model; parameters whose value the runs determine beforehand are fixed.
    run_names : tuple of str
        Names of the runs.
    spans : tuple of Span
        Duration, places and speeds that each run covers.
    absent : frozenset of (str, int)
        Pairs (effect, run) of per-run events that a run does not show. Their coefficients are zero there.
    slots : tuple of Slot
        The P unknowns in order.
    fixed : dict
        (effect, parameter) to fixed value.
    constraints : tuple of Constraint
        Ties and converted fixed values.
    leaders : frozenset of int
        Positions of unknowns that other parameters follow, or the normal load. The model responds to them through
        these as well.

    """

    model: Model
    run_names: tuple[str, ...]
    spans: tuple[Span, ...]
    absent: frozenset[tuple[str, int]] = frozenset()
    slots: tuple[Slot, ...] = field(init=False)
    fixed: dict[tuple[str, str], float] = field(init=False)
    constraints: tuple[Constraint, ...] = field(init=False)
    leaders: frozenset[int] = field(init=False)

    def __post_init__(self) -> None:
        model = _with_known_values(self.model, self.span)
        parameters = [(e, p) for e in model.effects for p in e.parameters]
        object.__setattr__(self, "model", model)
        slots = [
            Slot(e.name, p.name, run, p.linear, search_bounds(p, self.span if run is None else self.spans[run]), p.unit)
            for e, p in parameters
            if p.free
            for run in (self._present_runs(e) if p.per_run else [None])
        ]
        if len(self.run_names) > 1 and self.has_levels:
            slots += [Slot(LEVEL, "level", r, False, (0.05, 20.0), "1") for r in range(len(self.run_names))]
        object.__setattr__(self, "slots", tuple(slots))
        object.__setattr__(self, "fixed", {(e.name, p.name): p.fixed for e, p in parameters if p.fixed is not None})
        object.__setattr__(self, "constraints", constraints_of(model))
        object.__setattr__(self, "leaders", frozenset(self._leaders()))

    def _leaders(self) -> list[int]:
        """Positions of the unknowns that other parameters follow."""
        targets = {(c.value.effect, c.value.parameter) for c in self.constraints if isinstance(c.value, Tie)}
        any_reported = any(c.is_reported_differently for c in self.constraints)
        scaled = any(not isinstance(c.value, Tie) for c in self.constraints)
        if "gravity" in self.model:
            targets |= {("gravity", "g"), ("slope", "F")}
        return [
            i
            for i, s in enumerate(self.slots)
            if (any_reported and s.effect != LEVEL)
            or (s.effect, s.parameter) in targets
            or (scaled and s.effect == MASS)
        ]

    def _present_runs(self, effect: Effect) -> list[int]:
        """Runs in which an effect is present."""
        return [r for r in range(len(self.run_names)) if (effect.name, r) not in self.absent]

    @property
    def span(self) -> Span:
        """Duration, places and speeds that all runs together cover."""
        first = self.spans[0]
        return replace(
            first,
            duration=max(s.duration for s in self.spans),
            x_min=min(s.x_min for s in self.spans),
            x_max=max(s.x_max for s in self.spans),
            v_min=min(s.v_min for s in self.spans),
            v_max=max(s.v_max for s in self.spans),
            earlier=max((s.earlier for s in self.spans), key=len),
            cycle=first.cycle if np.allclose([s.cycle for s in self.spans], first.cycle, rtol=1e-3) else 0.0,
        )

    @property
    def has_levels(self) -> bool:
        """Whether an effect scales with the run's friction level and no per-run coefficient replaces it."""
        has_run_values = any(p.loaded and p.per_run and not p.role for e in self.model.effects for p in e.parameters)
        return not has_run_values and any(e.scales_with == "load" for e in self.model.effects)

    @property
    def has_scale_constraint(self) -> bool:
        """Whether a fixed value, prior or upper bound of a coefficient determines the scale of the friction levels."""
        loaded = [p for e in self.model.effects for p in e.parameters if p.loaded]
        return any(not p.free or p.prior is not None or np.isfinite(p.bounds[1]) for p in loaded)

    @property
    def names(self) -> list[str]:
        """Addresses of all unknowns, in order."""
        return [s.name(self.run_names) for s in self.slots]

    def effect(self, name: str) -> Effect:
        """Return an effect of the model by its name."""
        return next(e for e in self.model.effects if e.name == name)

    def by_address(self, p: Array) -> dict[str, float]:
        """Return unknowns p (P,) by address; those of single runs also as their mean, by the address without a run."""
        each: dict[str, list[float]] = {}
        for s, value in zip(self.slots, p.tolist(), strict=True):
            each.setdefault(f"{s.effect}.{s.parameter}", []).append(value)
        means = {address: float(np.mean(values)) for address, values in each.items()}
        return means | dict(zip(self.names, p.tolist(), strict=True))

    def unknowns(self, known: Mapping[str, float], default: Array | float = 0.0) -> Array:
        """Return unknowns (P,) with known values by address, with or without a run; `default` (P,) for the others."""
        others = zip(self.names, np.broadcast_to(default, len(self.slots)), strict=True)
        return np.array([known.get(name, known.get(name.partition("[")[0], other)) for name, other in others])

    @property
    def levels(self) -> list[int]:
        """Positions of the friction levels."""
        return [i for i, s in enumerate(self.slots) if s.effect == LEVEL]

    def sizes(self, effect: Effect, run: int | None = None) -> list[int]:
        """Positions of the sizes of an effect: of all runs, or the shared ones and those of one run."""
        of = {(effect.name, p.name) for p in effect.parameters if p.is_size}
        own = [(i, s.run) for i, s in enumerate(self.slots) if (s.effect, s.parameter) in of]
        return [i for i, its in own if run is None or its in (None, run)]

    @property
    def loaded(self) -> Mask:
        """Which unknowns are coefficients that carry the load, and so the friction level of the run, (P,)."""
        loaded = {(e.name, q.name) for e in self.model.effects for q in e.parameters if q.loaded}
        return np.array([(s.effect, s.parameter) in loaded for s in self.slots], dtype=bool)

    @property
    def coefficients(self) -> Mask:
        """Which unknowns the motion depends on nearly linearly: coefficients and friction levels, (P,)."""
        return np.array([s.linear or s.effect == LEVEL for s in self.slots], dtype=bool)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, each (P,)."""
        low, high = np.array([s.bounds for s in self.slots]).reshape(-1, 2).T
        return low, high

    def active(self, run: int) -> list[int]:
        """Return the positions of the unknowns that affect one run."""
        return list(self._active[run])

    @cached_property
    def _active(self) -> list[list[int]]:
        runs = range(len(self.run_names))
        return [[i for i, s in enumerate(self.slots) if s.run in (None, run)] for run in runs]

    def values(self, p: Array, run: int) -> tuple[dict[str, dict[str, Any]], Any]:
        """Compute the internal parameter values of one run.

        Parameters
        ----------
        p : array of shape (P,), or (Q, P) for a population
            The unknowns.
        run : int
            Index of the run.

        Returns
        -------
        values : dict
            Effect name to parameter name to value, (Q,) for a population, constraints applied.
        level : float
            Friction level of the run, 1 where it has none.

        """
        out: dict[str, dict[str, float]] = {e.name: {} for e in self.model.effects}
        for (effect, name), value in self.fixed.items():
            out[effect][name] = value
        level, values = 1.0, p.T if p.ndim > 1 else p.tolist()
        for i in self._active[run]:
            slot = self.slots[i]
            if slot.effect == LEVEL:
                level = values[i]
            else:
                out[slot.effect][slot.parameter] = values[i]
        for e in self.model.effects:  # an event that this run does not show
            if (e.name, run) in self.absent:
                out[e.name] |= {q.name: 0.0 if q.linear else 1.0 for q in e.parameters if q.per_run}
        apply_constraints(self.model, self.constraints, out)
        return out, level

    def reported_values(self, p: Array) -> dict[str, float]:
        """Compute the reported value of every parameter by address: fitted, fixed and tied ones."""
        q = mass_ratio(self, p)
        scaled = {e.name for e in self.model.effects if e.acts_on == "force" and e.name != MASS}
        out = {
            name: float(p[i]) / (q if s.linear and s.effect in scaled else 1.0)
            for i, (s, name) in enumerate(zip(self.slots, self.names, strict=True))
            if s.effect != LEVEL
        }
        out |= {f"{effect}.{name}": value for (effect, name), value in self.fixed.items()}
        computed = [(e, r) for e in self.model.effects for r in e.parameters if r.tie or r.name in e.quoted]
        each = [self.values(p, run)[0] for run in range(len(self.run_names))] if computed else []
        for e, r in computed:
            found = [reported_value(self.model, values, e.name, r.name) for values in each]
            for address, run in self._addresses(e, r):
                out[address] = float(np.mean(found) if run is None else found[run])
        return out

    def tied_parameters(self) -> list[tuple[str, Tie, str]]:
        """Return address, tie and unit of every tied parameter, run by run where it has a value per run."""
        tied = [(e, p) for e in self.model.effects for p in e.parameters if p.tie]
        return [(address, Tie.read(str(p.tie)), p.unit) for e, p in tied for address, _ in self._addresses(e, p)]

    def _addresses(self, effect: Effect, p: Parameter) -> list[tuple[str, int | None]]:
        """Addresses of a parameter, each with its run; None for a value of all runs."""
        name = f"{effect.name}.{p.name}"
        if not self._has_run_values(p):
            return [(name, None)]
        return [(f"{name}[{self.run_names[run]}]", run) for run in self._present_runs(effect)]

    def _has_run_values(self, p: Parameter) -> bool:
        """Whether a parameter has a value per run. A tied parameter has, if the one that it follows has."""
        if p.tie is None:
            return p.per_run and p.fixed is None
        tie = Tie.read(p.tie)
        return self._has_run_values(self.effect(tie.effect).parameter(tie.parameter))

    @cached_property
    def priors(self) -> tuple[ReportedPrior, ...]:
        """Priors of the unknowns, in order; one per run where the parameter has a value per run."""
        effects = {e.name: e for e in self.model.effects}
        out = []
        for i, slot in enumerate(self.slots):
            effect = effects.get(slot.effect)
            prior = effect and effect.parameter(slot.parameter).prior
            if effect and prior:
                is_direct = slot.parameter not in effect.quoted and not (slot.linear and MASS in effects)
                phase = effect.parameter(slot.parameter).role == "phase"
                out.append(ReportedPrior(self.names[i], *prior, i if is_direct else None, phase))
        return tuple(out)

    @cached_property
    def prior_covariance(self) -> Array:
        """Covariance (m, m) of the priors, from their standard deviations and correlations."""
        std, at = np.array([q.std for q in self.priors]), {q.address: i for i, q in enumerate(self.priors)}
        matrix = np.eye(len(at))
        for e in self.model.effects:
            for p in e.parameters:
                i = at.get(f"{e.name}.{p.name}")
                for other, r in p.prior_correlation if i is not None else ():
                    if other in at:
                        matrix[i, at[other]] = matrix[at[other], i] = r
        if at and np.linalg.eigvalsh(matrix)[0] <= 0:
            raise UsageError("expected prior_correlation that can hold together (positive definite)")
        return np.asarray(matrix * std * std[:, None], dtype=np.float64)

    @cached_property
    def prior_whitening(self) -> Array:
        """Matrix (m, m) that turns deviations from the means of the priors into independent standard deviations."""
        return whitening_matrix(self.prior_covariance)

    def are_shared_unknowns(self, effect: str, *parameters: str) -> bool:
        """Return whether all these parameters of an effect are unknowns that the runs share."""
        shared = {s.parameter for s in self.slots if s.effect == effect and s.run is None}
        return shared.issuperset(parameters)

    def index(self, effect: str, parameter: str, run: int | None = None) -> int:
        """Return the position of one unknown; raise KeyError if there is none."""
        for i, s in enumerate(self.slots):
            if (s.effect, s.parameter, s.run) == (effect, parameter, run):
                return i
        raise KeyError((effect, parameter, run))


def mass_ratio(layout: ParameterLayout, p: Array) -> float:
    """Compute q, the unit of mass over the mass, from unknowns p (P,); 1 for a known mass."""
    return 1.0 + sum(float(p[i]) for i, s in enumerate(layout.slots) if s.effect == MASS)


def whitening_matrix(covariance: Array) -> Array:
    """Compute W (m, m) with W' W the inverse of a covariance."""
    std = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / std / std[:, None])
    return np.asarray(np.linalg.inv(factor) / std, dtype=np.float64)


def _with_known_values(model: Model, span: Span) -> Model:
    """The model with those parameters fixed that the runs determine beforehand."""
    known = [
        {p.name: {"fixed": known_value(p, span)} for p in e.parameters if p.free and p.known} for e in model.effects
    ]
    return replace(model, effects=tuple(e.adjusted(**own) for e, own in zip(model.effects, known, strict=True)))


def known_value(p: Parameter, span: Span) -> float | None:
    """Return the fixed value of a parameter, or the one that the runs determine; None if it is free."""
    return p.fixed if p.fixed is not None or p.known is None else p.known(span)


def search_bounds(p: Parameter, span: Span) -> tuple[float, float]:
    """Compute the bounds of a parameter for these runs: its own, or just beyond its scan where it has none.

    That is one step of the scan; a place may lie farther off, for a run may stop in the flank of what acts there.
    """
    low, high = p.bounds
    if p.scan is None:
        return low, high
    grid = np.sort(p.scan(span))
    margin = PLACE_MARGIN * np.ptp(grid) if p.unit == "m" else 0.0
    if not np.isfinite(low):
        low = float(grid[0] - max(grid[1] - grid[0], margin) if p.signed else grid[0] ** 2 / grid[1])
    if not np.isfinite(high):
        high = float(grid[-1] + max(grid[-1] - grid[-2], margin) if p.signed else grid[-1] ** 2 / grid[-2])
    return low, high


def canonical_form(layout: ParameterLayout, p: Array) -> Array:
    """Bring unknowns (P,) to their canonical form: amplitudes positive, phases between -pi and pi.

    Unknowns that others follow, and phases with bounds narrower than 2 pi, are left unchanged.
    """
    p = np.array(p, dtype=float)
    for effect in layout.model.effects:
        own = [(i, effect.parameter(s.parameter).role) for i, s in enumerate(layout.slots) if s.effect == effect.name]
        phases = [i for i, role in own if role == "phase"]
        sizes = [i for i, role in own if role in ("amplitude", "depth")]
        if layout.leaders & {*phases, *sizes} or any(np.ptp(layout.slots[i].bounds) < 2 * np.pi - 1e-9 for i in phases):
            continue
        if phases and len(sizes) in (1, len(phases)):
            p[phases] += np.pi * (p[sizes] < 0)
            p[sizes] = np.abs(p[sizes])
        p[phases] = (p[phases] + np.pi) % (2 * np.pi) - np.pi
    return p


def normalise_levels(layout: ParameterLayout, p: Array) -> Array:
    """Scale the friction levels to about one and the coefficients that carry the load by the inverse factor.

    The factor brings the levels closest to one in least squares. With too few runs for a scatter it is their mean.
    The motion does not change. Levels stay as they are where a coefficient already determines their scale.
    """
    levels = layout.levels
    if not levels or layout.has_scale_constraint:
        return p
    too_few = len(levels) < MIN_RUNS_FOR_SCATTER
    factor = float(np.mean(p[levels])) if too_few else float(np.sum(p[levels] ** 2) / np.sum(p[levels]))
    p = np.array(p)
    p[levels] /= factor
    p[layout.loaded] *= factor
    return p


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Return -D, shape (n, 1): N per unit of q - 1; zero without a drive."""
    return -(np.zeros_like(path.t) if path.drive is None else path.drive)[:, None]


MASS_EFFECT = Effect(
    name=MASS,
    acts_on="force",
    equation="",
    parameters=(Parameter("m", "kg", (MIN_MASS_RATIO - 1.0, np.inf), linear=True),),
    columns=columns,
    varies_with="",
    what="The mass that slides, where it was not weighed but the drive was measured.",
)


def is_mass_unknown(runs: Sequence[Run]) -> bool:
    """Return whether the mass of these runs is to be fitted.

    Raises
    ------
    FrictrackError
        If the mass cannot be fitted: no measured drive, or only some runs have a mass.

    """
    unknown = [r.name for r in runs if r.mass is None]
    undriven = [r.name for r in runs if r.mass is None and r.drive is None]
    if undriven:
        raise FrictrackError(
            f'run "{undriven[0]}": expected a mass for a fit of the displacement but got none, and without a measured '
            "drive force and mass scale together: weigh the slider and give mass, or measure the drive"
        )
    if unknown and len(unknown) < len(runs):
        raise FrictrackError(
            f"expected one mass to be fitted for all runs but only {', '.join(unknown)} of {len(runs)} runs leave it "
            "open; leave it open for all, or weigh these too"
        )
    return bool(unknown)


def with_mass(model: Model) -> Model:
    """Add the mass to the unknowns of a model.

    Raises
    ------
    FrictrackError
        (usage) For bounds in newtons, which cannot be applied before the mass is known.

    """
    for effect in (e for e in model.effects if e.acts_on == "force"):
        for p in effect.linear:
            if any(np.isfinite(b) and b != 0 for b in p.bounds):
                raise UsageError(
                    f"expected no bounds of {effect.name}.{p.name} where the mass is fitted too: forces are known "
                    f"only with it; give prior = {{{p.name} = [mean, std]}} instead, or fix it"
                )
    return Model((*model.effects, MASS_EFFECT))


def without_mass(model: Model) -> Model:
    """Return the model without the mass among its effects."""
    return Model(tuple(e for e in model.effects if e.name != MASS))


def rescale_to_mass(layout: ParameterLayout, p: Array, q: float) -> Array:
    """Convert unknowns p (P,) to a unit of mass that is q times smaller."""
    out = np.array(p, dtype=float)
    forces = {e.name for e in layout.model.effects if e.acts_on == "force"}
    for i, s in enumerate(layout.slots):
        if s.effect == MASS:
            out[i] = (1.0 + p[i]) / q - 1.0
        elif s.linear and s.effect in forces:
            out[i] = p[i] / q
    return out


def with_fitted_mass(run: Run, mass: float) -> Run:
    """Return the run with the fitted mass (kg) if it had none."""
    return run if run.mass is not None or run.drive is None else replace(run, mass=mass)
