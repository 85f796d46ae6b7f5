"""The layout of the parameter vector: which unknowns are shared, which belong to one run, and the friction levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from frictrack.effects import Effect, Parameter, Span, Tie
from frictrack.fit.parameters.constraints import MASS, Constraint, apply_constraints, constraints_of, reported_value
from frictrack.fit.parameters.prior_covariance import ReportedPrior, covariance_of_priors, whitening
from frictrack.models import Model
from frictrack.records import Array, Mask

LEVEL = "level"  # pseudo-effect: the run's own factor on dry friction
MIN_RUNS_FOR_SCATTER = 4  # with fewer runs the scatter is not estimated; levels are free with mean one


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
    levels_free : bool
        Leave the friction levels without penalty, as for a run that the others predict.
    slots : tuple of Slot
        The P unknowns in order.
    fixed : dict
        (effect, parameter) to fixed value.
    constraints : tuple of Constraint
        Ties and converted fixed values.
    leaders : frozenset of int
        Positions of unknowns that other parameters follow. The model responds to them through these as well.

    """

    model: Model
    run_names: tuple[str, ...]
    spans: tuple[Span, ...]  # duration, places and speeds of each run
    absent: frozenset[tuple[str, int]] = frozenset()
    levels_free: bool = False  # no penalty on the levels (for a run predicted by the others)
    slots: tuple[Slot, ...] = field(init=False)
    fixed: dict[tuple[str, str], float] = field(init=False)
    constraints: tuple[Constraint, ...] = field(init=False)
    leaders: frozenset[int] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", _with_known_values(self.model, self.span))
        slots: list[Slot] = []
        fixed: dict[tuple[str, str], float] = {}
        for effect in self.model.effects:
            for p in effect.parameters:
                known = known_value(p, self.span)
                if known is not None:
                    fixed[effect.name, p.name] = known
                if known is not None or p.tie is not None:
                    continue
                for run in self._runs_with(effect, p.per_run):
                    bounds = search_bounds(p, self.span if run is None else self.spans[run])
                    slots.append(Slot(effect.name, p.name, run, p.linear, bounds, p.unit))
        if len(self.run_names) > 1 and self.has_levels:
            slots += [Slot(LEVEL, "level", r, False, (0.05, 20.0), "1") for r in range(len(self.run_names))]
        object.__setattr__(self, "slots", tuple(slots))
        object.__setattr__(self, "fixed", fixed)
        object.__setattr__(self, "constraints", constraints_of(self.model))
        object.__setattr__(self, "leaders", frozenset(self._leaders()))

    def _leaders(self) -> list[int]:
        """Positions of the unknowns that other parameters follow."""
        targets, any_reported = set(), False
        for constraint in self.constraints:
            any_reported = any_reported or constraint.is_reported_differently
            if isinstance(constraint.value, Tie):
                targets.add((constraint.value.effect, constraint.value.parameter))
        scaled = any(not isinstance(r.value, Tie) for r in self.constraints)
        return [
            i
            for i, s in enumerate(self.slots)
            if (any_reported and s.effect != LEVEL)
            or (s.effect, s.parameter) in targets
            or (scaled and s.effect == MASS)
        ]

    def _runs_with(self, effect: Effect, per_run: bool) -> list[int | None]:
        """Runs in which an effect has a value: [None] for a shared parameter."""
        if not per_run:
            return [None]
        return [r for r in range(len(self.run_names)) if (effect.name, r) not in self.absent]

    @property
    def span(self) -> Span:
        """Duration, places and speeds that all runs together cover."""
        return common_span(self.spans)

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

    @property
    def levels(self) -> list[int]:
        """Positions of the friction levels."""
        return [i for i, s in enumerate(self.slots) if s.effect == LEVEL]

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
        if run not in self._active:
            self._active[run] = [i for i, s in enumerate(self.slots) if s.run in (None, run)]
        return list(self._active[run])

    @cached_property
    def _active(self) -> dict[int, list[int]]:
        """Unknowns that affect each run, as far as they were asked for."""
        return {}

    def values(self, p: Array, run: int) -> tuple[dict[str, dict[str, float]], float]:
        """Compute the internal parameter values of one run.

        Parameters
        ----------
        p : array of shape (P,)
            The unknowns.
        run : int
            Index of the run.

        Returns
        -------
        values : dict
            Effect name to parameter name to value, constraints applied.
        level : float
            Friction level of the run, 1 where it has none.

        """
        out: dict[str, dict[str, float]] = {e.name: {} for e in self.model.effects}
        for (effect, name), value in self.fixed.items():
            out[effect][name] = value
        level = 1.0
        for i in self.active(run):
            slot = self.slots[i]
            if slot.effect == LEVEL:
                level = float(p[i])
            else:
                out[slot.effect][slot.parameter] = float(p[i])
        for e in self.model.effects:  # an event that this run does not show
            if (e.name, run) in self.absent:
                out[e.name] |= {q.name: 0.0 if q.linear else 1.0 for q in e.parameters if q.per_run}
        apply_constraints(self.model, self.constraints, out)
        return out, level

    def reported_values(self, p: Array) -> dict[str, float]:
        """Compute the reported value of every parameter by address: fitted, fixed and tied ones."""
        q = 1.0 + sum(float(p[i]) for i, s in enumerate(self.slots) if s.effect == MASS)
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
            if self.has_run_values(e, r):
                present = [run for run in self._runs_with(e, True) if run is not None]
                out |= {f"{e.name}.{r.name}[{self.run_names[run]}]": float(found[run]) for run in present}
            else:
                out[f"{e.name}.{r.name}"] = float(np.mean(found))
        return out

    def tied_parameters(self) -> list[tuple[str, Tie, str]]:
        """Return address, tie and unit of every tied parameter, run by run where it has a value per run."""
        out = []
        for e in self.model.effects:
            for p in (p for p in e.parameters if p.tie):
                runs = [r for r in self._runs_with(e, True) if r is not None] if self.has_run_values(e, p) else [None]
                places = ["" if r is None else f"[{self.run_names[r]}]" for r in runs]
                out += [(f"{e.name}.{p.name}{place}", Tie.read(str(p.tie)), p.unit) for place in places]
        return out

    @cached_property
    def priors(self) -> tuple[ReportedPrior, ...]:
        """Priors of the unknowns, in order; one per run where the parameter has a value per run."""
        effects = {e.name: e for e in self.model.effects}
        mass_known = MASS not in effects
        found_priors = []
        for i, slot in enumerate(self.slots):
            prior = None if slot.effect == LEVEL else effects[slot.effect].parameter(slot.parameter).prior
            if prior is not None:
                effect = effects[slot.effect]
                is_direct = slot.parameter not in effect.quoted and (mass_known or not slot.linear)
                found_priors.append(
                    ReportedPrior(self.names[i], *prior, i if is_direct else None, _role(effect, slot) == "phase")
                )
        return tuple(found_priors)

    @cached_property
    def prior_covariance(self) -> Array:
        """Covariance (m, m) of the priors."""
        return covariance_of_priors(self.model, self.priors)

    @cached_property
    def prior_whitening(self) -> Array:
        """Matrix (m, m) that turns deviations from the means of the priors into independent standard deviations."""
        return whitening(self.prior_covariance)

    def has_run_values(self, effect: Effect, p: Parameter) -> bool:
        """Return whether a parameter has a value per run. A tied parameter has, if the one that it follows has."""
        if p.tie is None:
            return p.per_run and p.fixed is None
        tie = Tie.read(p.tie)
        leader = next(e for e in self.model.effects if e.name == tie.effect)
        return self.has_run_values(leader, leader.parameter(tie.parameter))

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


def _with_known_values(model: Model, span: Span) -> Model:
    """The model with those parameters fixed that the runs determine beforehand."""
    known = [
        e.adjusted(
            **{
                p.name: {"fixed": known_value(p, span)}
                for p in e.parameters
                if p.free and known_value(p, span) is not None
            }
        )
        for e in model.effects
    ]
    return replace(model, effects=tuple(known))


def known_value(p: Parameter, span: Span) -> float | None:
    """Return the fixed value of a parameter, or the one that the runs determine; None if it is free."""
    return p.fixed if p.fixed is not None or p.known is None else p.known(span)


def search_bounds(p: Parameter, span: Span) -> tuple[float, float]:
    """Compute the bounds of a parameter for these runs: its own, or one step beyond its scan where it has none."""
    low, high = p.bounds
    if p.scan is None:
        return low, high
    grid = np.sort(p.scan(span))
    if not np.isfinite(low):
        low = float(grid[0] - (grid[1] - grid[0]) if p.signed else grid[0] ** 2 / grid[1])
    if not np.isfinite(high):
        high = float(grid[-1] + (grid[-1] - grid[-2]) if p.signed else grid[-1] ** 2 / grid[-2])
    return low, high


def common_span(spans: Sequence[Span]) -> Span:
    """Compute the span that several runs cover together."""
    return Span(
        duration=max(s.duration for s in spans),
        x_min=min(s.x_min for s in spans),
        x_max=max(s.x_max for s in spans),
        v_min=min(s.v_min for s in spans),
        v_max=max(s.v_max for s in spans),
        fps=spans[0].fps,
        clamp_x=spans[0].clamp_x,
        beam_length=spans[0].beam_length,
        earlier=max((s.earlier for s in spans), key=len),
    )


def canonical_form(layout: ParameterLayout, p: Array) -> Array:
    """Bring unknowns to their canonical form: amplitudes positive, phases between -pi and pi.

    Unknowns that others follow, and phases with bounds narrower than 2 pi, are left unchanged.

    Parameters
    ----------
    layout : ParameterLayout
        The layout.
    p : array of shape (P,)
        The unknowns.

    Returns
    -------
    array of shape (P,)
        Unknowns of the same model in canonical form.

    """
    p = np.array(p, dtype=float)
    for effect in layout.model.effects:
        phases = [i for i, s in enumerate(layout.slots) if s.effect == effect.name and _role(effect, s) == "phase"]
        sizes = [
            i for i, s in enumerate(layout.slots) if s.effect == effect.name and _role(effect, s) in _AMPLITUDE_ROLES
        ]
        if layout.leaders & {*phases, *sizes} or any(np.ptp(layout.slots[i].bounds) < 2 * np.pi - 1e-9 for i in phases):
            continue
        if phases and len(sizes) == 1 and p[sizes[0]] < 0:
            p[sizes[0]] *= -1
            p[phases] += np.pi
        elif phases and len(sizes) == len(phases):
            flip = p[sizes] < 0
            p[sizes] = np.abs(p[sizes])
            p[phases] += np.pi * flip
        p[phases] = (p[phases] + np.pi) % (2 * np.pi) - np.pi
    return p


def normalise_levels(layout: ParameterLayout, p: Array) -> Array:
    """Scale the friction levels to about one and the coefficients that carry the load by the inverse factor.

    The factor brings the levels closest to one in least squares. With too few runs for a scatter it is their mean.
    The motion does not change. Levels stay as they are where a coefficient already determines their scale.

    Parameters
    ----------
    layout : ParameterLayout
        The layout.
    p : array of shape (P,)
        The unknowns.

    Returns
    -------
    array of shape (P,)
        Unknowns of the same motion.

    """
    levels = layout.levels
    if not levels or layout.levels_free or layout.has_scale_constraint:
        return p
    too_few = len(levels) < MIN_RUNS_FOR_SCATTER
    factor = float(np.mean(p[levels])) if too_few else float(np.sum(p[levels] ** 2) / np.sum(p[levels]))
    p = np.array(p)
    p[levels] /= factor
    loaded = [
        i
        for e in layout.model.effects
        for i, s in enumerate(layout.slots)
        if s.effect == e.name and e.parameter(s.parameter).loaded
    ]
    p[loaded] *= factor
    return p


_AMPLITUDE_ROLES = ("amplitude", "depth")


def _role(effect: Effect, slot: Slot) -> str:
    return effect.parameter(slot.parameter).role
