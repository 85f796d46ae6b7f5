"""The separable model along the measured motion: rows per unit coefficient for given non-linear parameters.

Independent effects are evaluated alone, a modifier together with the effects that it modifies (`EffectGroup`). A
sinusoid of one amplitude and one phase enters as two quadratures, which are linear. If the phase belongs to the runs,
every run has its own pair, and their common amplitude is left to the refinement.

Data along the measured motion, and the linear map from a force to the change that it makes in them.

A block is one stretch of one run. Its data (m,) are what the forces (and measurement shifts) of a model must explain
after `forward`, in units of the noise. Forces are rows (..., n), so that a population is mapped at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from frictrack.effects import Effect, Path, Tie, joined_paths
from frictrack.effects.models import Model
from frictrack.fit.parameters import LEVEL, ParameterLayout, apply_constraints, canonical_form
from frictrack.fit.pieces import Piece, consecutive_slices
from frictrack.records import Array, Mask

MAX_SAMPLES_KEPT = 20_000  # of a tiled path: to evaluate an effect along a longer one takes far longer than to tile it
MIN_SAMPLES_PER_COMPARED = 2  # samples per compared frame from which a separate path is worth its cost
Forward = Callable[[Array], Array]  # rows (..., n) to rows (..., m)
Indices = NDArray[np.int_]
Values = dict[str, dict[str, Any]]
QUADRATURES = (0.0, np.pi / 2)


@dataclass(frozen=True, eq=False)
class DataBlock:
    """One stretch of one run: data (m,) ~ forward(force) + picture(shift), white noise of standard deviation one.

    Attributes
    ----------
    run : int
        Index of the run.
    path : Path
        Motion at the n samples.
    data : array of shape (m,)
        Whitened data.
    forward : callable
        Maps forces (..., n), N, to data (..., m).
    picture : callable
        Maps measurement shifts (..., n), m, to data (..., m).
    friction : array of shape (n,)
        Measured force at the reference load, N.
    rest : float
        Part of the squared data that no force along the path can change.
    highest : float
        Highest frequency at which periodic effects are searched, Hz.
    compared_path : Path, optional
        The path at the compared samples only, where these are few. It suffices for effects without memory.

    """

    run: int
    path: Path
    data: Array
    forward: Forward
    picture: Forward
    friction: Array
    rest: float = 0.0
    highest: float = np.inf
    compared_path: Path | None = None

    def evaluation_path(self, has_memory: bool) -> Path:
        """Return the path on which effects are evaluated: those without memory at the compared samples only."""
        return self.path if self.compared_path is None or has_memory else self.compared_path


def at_samples(model: Model) -> bool:
    """Return whether the columns of all effects at a sample depend on nothing before it."""
    return all(e.varies_with is not None and not e.memory for e in model.effects)


def joined_blocks(blocks: Sequence[DataBlock]) -> DataBlock:
    """Return blocks end to end as one, for effects whose columns at a sample depend on nothing before it."""
    paths = [block.evaluation_path(False) for block in blocks]
    pairs = list(zip(blocks, consecutive_slices(len(path.t) for path in paths), strict=True))
    return replace(
        blocks[0],
        path=joined_paths(paths),
        compared_path=None,
        data=np.concatenate([block.data for block in blocks]),
        forward=lambda rows: np.concatenate([block.forward(rows[..., cut]) for block, cut in pairs], axis=-1),
        picture=lambda rows: np.concatenate([block.picture(rows[..., cut]) for block, cut in pairs], axis=-1),
        friction=np.concatenate([block.friction for block in blocks]),
        rest=sum(block.rest for block in blocks),
    )


def displacement_block(piece: Piece) -> DataBlock:
    """Create a block from the displacement of a piece."""
    q, _ = np.linalg.qr(piece.whitened(np.column_stack([np.ones_like(piece.t), piece.t])))
    twice = double_integral(piece.t)

    def picture(rows: Array) -> Array:
        white = np.moveaxis(piece.whitened(np.moveaxis(rows, -1, 0)), 0, -1)
        return white - (white @ q) @ q.T

    known = np.interp(piece.t, piece.panels.t, piece.known)
    return DataBlock(
        run=piece.run,
        path=path_of(piece),
        data=picture(piece.y - twice(known)),
        forward=lambda rows: picture(twice(rows) * (-1.0 / piece.mass)),
        picture=picture,
        friction=friction_series(piece),
    )


def rows_at_compared(rows: Array, at: NDArray[np.int_]) -> Array:
    """Select the compared samples `at` (m,) of rows (..., n). Rows (..., m) are returned unchanged.

    Examples
    --------
    >>> rows_at_compared(np.arange(4.0), np.array([1, 3]))
    array([1., 3.])
    >>> rows_at_compared(np.array([5.0, 7.0]), np.array([1, 3]))
    array([5., 7.])

    """
    return rows if rows.shape[-1] == len(at) else rows[..., at]


def path_at_compared(piece: Piece, x: Array, v: Array, level: float) -> Path | None:
    """Return the path of a motion x, v (n,) at the compared frames only; None where these are most of its samples."""
    if MIN_SAMPLES_PER_COMPARED * len(piece.at) > len(piece.path.t):
        return None
    return piece.at_frames(x[piece.at], v[piece.at], level)


def path_of(piece: Piece) -> Path:
    """Return the measured motion of a piece at its frames."""
    nodes, t = piece.panels.t, piece.t
    path = piece.at_frames(CubicSpline(nodes, piece.x_hat)(t), CubicSpline(nodes, piece.v_hat)(t), 1.0)
    return replace(path, drive=None if piece.path.drive is None else np.interp(t, nodes, piece.path.drive))


def double_integral(t: Array) -> Forward:
    """Create the operator that integrates rows (..., n) over t (n,) twice, with start position and speed zero.

    The second difference x[i+1] - 2 x[i] + x[i-1] is the mean of the force under a hat function, with the force a
    parabola in between. For evenly spaced frames these are Numerov's weights h^2 (1, 10, 1)/12.

    References
    ----------
    Hairer, E., Norsett, S. P. & Wanner, G. (1993). Solving Ordinary Differential Equations I, sec. III.10. Springer.

    """
    before, after = np.diff(t)[:-1], np.diff(t)[1:]
    tilt, bend = (after**2 - before**2) / 6, (before**3 + after**3) / 12
    left = (bend - after * tilt) / (before * (before + after))
    right = (bend + before * tilt) / (after * (before + after))
    middle = (before + after) / 2 - left - right

    def twice(rows: Array) -> Array:
        kinks = left * rows[..., :-2] + middle * rows[..., 1:-1] + right * rows[..., 2:]
        out = np.zeros_like(rows)
        np.cumsum(after * np.cumsum(kinks, axis=-1), axis=-1, out=out[..., 2:])
        return out

    return twice


def friction_series(piece: Piece) -> Array:
    """The friction force at the reference load along the measured motion of a piece, at its frames (n,), N."""
    path = piece.path_at_nodes(piece.x_hat, piece.v_hat, 1.0)
    force = piece.mass * (piece.known - piece.a_hat) / path.load
    return np.interp(piece.t, piece.panels.t, force)


def tiled_path(path: Path, count: int) -> Path:
    """Return a path `count` times end to end, for a population; the last short one is kept with the path."""
    if count == 1:
        return path
    kept: tuple[int, Path] | None = vars(path).get("_tiled")
    if kept is not None and kept[0] == count:
        return kept[1]
    n = len(path.t)
    repeated: dict[str, Any] = {
        one.name: np.tile(value, count)
        for one in fields(path)
        if isinstance(value := getattr(path, one.name), np.ndarray) and value.shape == (n,)
    }
    starts = np.add.outer(n * np.arange(count), path.starts)
    tiled = replace(path, starts=tuple(starts.ravel().tolist()), **repeated)
    if n * count <= MAX_SAMPLES_KEPT:
        vars(path)["_tiled"] = count, tiled
    return tiled


def repeat_values(values: Any, n: int, is_depth: bool) -> Any:
    """Repeat the values (Q,) of a population, n samples each; a common value stays a number.

    A depth multiplies whole columns (n, k), so it has shape (Q n, 1).
    """
    values = np.ravel(values)
    if values.size == 1 or (values == values[0]).all():
        return float(values[0])
    repeated = np.repeat(values, n)
    return repeated[:, None] if is_depth else repeated


@dataclass(frozen=True)
class Coefficient:
    """One linear coefficient: a parameter of an effect, shared (run None) or of one run.

    Of a sinusoid it is one quadrature.
    """

    effect: str
    parameter: str
    run: int | None
    bounds: tuple[float, float]
    quadrature: int | None = None
    loaded: bool = False


@dataclass(frozen=True)
class EffectGroup:
    """Effects that are evaluated together.

    `nonlinear_slots` are the positions in the layout of the parameters that their columns depend on. The phases of a
    sinusoid (`phase_slots`) are separate, because its quadratures do not depend on them.
    """

    model: Model
    is_sinusoid: bool
    is_measurement: bool
    nonlinear_slots: tuple[int, ...]
    phase_slots: tuple[int, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of its effects."""
        return self.model.names

    def columns(self, path: Path, values: Values) -> Array:
        """Compute all columns of the group, (n, k)."""
        if len(self.model.effects) == 1:
            effect = self.model.effects[0]
            return effect.columns(path, values[effect.name])
        return np.concatenate(list(self.model.force_columns(path, values).values()), axis=1)


def coupled_effects(model: Model) -> list[list[Effect]]:
    """Effects that are evaluated together: modifiers with all that they modify, the others alone."""
    changed = [one for e in model.effects for one in e.changed(model.effects)]
    joined = [e for e in model.effects if e.modifies or e in changed]
    out: list[list[Effect]] = [[e] for e in model.effects if e not in joined]
    return [joined, *out] if joined else out


@dataclass(eq=False)
class SeparableModel:
    """A layout over data blocks, evaluated for one model or for a population.

    Attributes
    ----------
    layout : ParameterLayout
        The unknowns.
    blocks : sequence of DataBlock
        The data.
    groups : list of EffectGroup
        Effects that are evaluated together.
    coefficients : list of Coefficient
        The K linear coefficients.
    column_positions : list of dict
        For every group and run, the coefficient of each column; K for none.
    at : list of array
        For every group, the coefficient of each of its k columns: (k,) where it is the same in all data, else (k, M).
    group_coefficients : list of array of int
        The coefficients of every group.
    free : list of int
        Positions of the searched non-linear parameters: all but levels and the phases of sinusoids.

    """

    layout: ParameterLayout
    blocks: Sequence[DataBlock]

    def __post_init__(self) -> None:
        self.blocks = list(self.blocks)
        self.runs = sorted({b.run for b in self.blocks})
        self.groups = [self._group(effects) for effects in coupled_effects(self.layout.model)]
        self.coefficients: list[Coefficient] = []
        columns = [self._column_positions(group) for group in self.groups]
        none = len(self.coefficients)
        self.column_positions = [{r: np.where(at < 0, none, at) for r, at in own.items()} for own in columns]
        self.free = sorted({i for g in self.groups for i in g.nonlinear_slots})
        self.low, self.high = np.array([c.bounds for c in self.coefficients]).reshape(-1, 2).T
        self.loaded = np.array([c.loaded for c in self.coefficients], dtype=bool)
        self.slices = consecutive_slices(len(b.data) for b in self.blocks)
        self.data = np.concatenate([b.data for b in self.blocks])
        self.size = len(self.data)
        self.run_of_datum = np.repeat([b.run for b in self.blocks], [len(b.data) for b in self.blocks])
        self.group_coefficients = [
            np.array([i for i, c in enumerate(self.coefficients) if c.effect in group.names], dtype=int)
            for group in self.groups
        ]
        self.at = [self._coefficients_of_data(own) for own in self.column_positions]
        places = [[self._places(g, g.nonlinear_slots), self._places(g, self._inputs(g))] for g in self.groups]
        self.places = [np.array(list(own.values()), dtype=int) for own, _ in places]  # (q, runs) each
        self._sources = [inputs for _, inputs in places]
        self._fixed = {
            e.name: {q.name: self.layout.fixed.get((e.name, q.name), 1.0) for q in e.parameters if not q.linear}
            for e in self.layout.model.effects
        }
        self._evaluated = [self._blocks_of(g) for g in range(len(self.groups))]
        self.responses: dict[int, list[tuple[int, int, int | None]]] = {}
        for g, group in enumerate(self.groups):
            names = list(places[g][0])
            for i in group.nonlinear_slots:
                s = self.layout.slots[i]
                self.responses.setdefault(i, []).append((g, names.index((s.effect, s.parameter)), s.run))

    # --- positions of parameters

    def _group(self, effects: list[Effect]) -> EffectGroup:
        """The group of some effects, with the positions of its non-linear parameters."""
        is_sinusoid = len(effects) == 1 and self.is_sinusoid(effects[0])
        phases = {(e.name, q.name) for e in effects for q in e.nonlinear if is_sinusoid and q.role == "phase"}
        wanted = {(e.name, q.name) for e in effects for q in e.nonlinear} - phases
        wanted |= set(self._leaders(wanted))
        slots = self._positions(wanted), self._positions(phases)
        return EffectGroup(Model(tuple(effects)), is_sinusoid, effects[0].acts_on == "measurement", *slots)

    def _positions(self, wanted: set[tuple[str, str]]) -> tuple[int, ...]:
        """Positions of the wanted (effect, parameter) pairs in the layout."""
        slots = enumerate(self.layout.slots)
        return tuple(i for i, s in slots if (s.effect, s.parameter) in wanted and s.run in (None, *self.runs))

    def _leaders(self, followers: set[tuple[str, str]]) -> Iterable[tuple[str, str]]:
        """Parameters that others are tied to, directly or through further ties."""
        for constraint in self.layout.constraints:
            if (constraint.effect.name, constraint.parameter.name) in followers and isinstance(constraint.value, Tie):
                leader = constraint.value.effect, constraint.value.parameter
                yield leader
                yield from self._leaders({leader})

    def _inputs(self, group: EffectGroup) -> Iterable[int]:
        """Positions of all parameters that the columns of a group depend on; ties may lead to any effect."""
        if not self.layout.constraints:
            return (*group.nonlinear_slots, *group.phase_slots)
        return (i for i, s in enumerate(self.layout.slots) if not s.linear and s.effect != LEVEL)

    def _places(self, group: EffectGroup, slots: Iterable[int]) -> dict[tuple[str, str], Indices]:
        """Position of every parameter among some slots in each run; -1 where a run has none."""
        out: dict[tuple[str, str], Indices] = {}
        for i in slots:
            s = self.layout.slots[i]
            own = out.setdefault((s.effect, s.parameter), np.full(len(self.layout.run_names), -1))
            own[slice(None) if s.run is None else s.run] = i
        return out

    def is_sinusoid(self, effect: Effect) -> bool:
        """Return whether an effect is a free amplitude times a sine of a free phase, so that quadratures are linear."""
        sizes = [p for p in effect.linear if p.role == "amplitude"]
        phases = [p for p in effect.nonlinear if p.role == "phase"]
        if effect.modifies or len(effect.linear) != 1 or len(sizes) != 1 or len(phases) != 1:
            return False
        both = {sizes[0].name, phases[0].name}
        own = {i: s for i, s in enumerate(self.layout.slots) if s.effect == effect.name and s.parameter in both}
        return {s.parameter for s in own.values()} == both and not self.layout.leaders & own.keys()

    def _column_positions(self, group: EffectGroup) -> dict[int, Indices]:
        """Create the coefficients of a group, and return which of them its columns are in every run; -1 for none."""
        column_positions: dict[int, list[int]] = {run: [] for run in self.runs}
        for effect in group.model.effects:
            present = [r for r in self.runs if (effect.name, r) not in self.layout.absent]
            own_phase = group.is_sinusoid and any(q.per_run for q in effect.nonlinear if q.role == "phase")
            for p, quadrature in product(effect.linear, (0, 1) if group.is_sinusoid else (None,)):
                bounds = (-np.inf, np.inf) if group.is_sinusoid else self._bounds(effect.name, p.name)
                owners: list[int | None] = [*present] if p.per_run or own_phase else [None]
                first = {r: len(self.coefficients) + i for i, r in enumerate(owners)}
                self.coefficients += [Coefficient(effect.name, p.name, r, bounds, quadrature, p.loaded) for r in owners]
                for run in self.runs:
                    column_positions[run].append(first.get(None, first.get(run, -1)))
        return {run: np.array(at, dtype=int) for run, at in column_positions.items()}

    def _coefficients_of_data(self, own: dict[int, Indices]) -> Indices:
        """The coefficient of each of k columns: (k,) where all runs agree, else (k, M)."""
        each = [own[block.run] for block in self.blocks]
        if all(np.array_equal(each[0], other) for other in each):
            return each[0]
        return np.repeat(np.stack(each, axis=1), [len(block.data) for block in self.blocks], axis=1)

    def _bounds(self, effect: str, parameter: str) -> tuple[float, float]:
        fixed = self.layout.fixed.get((effect, parameter))
        if fixed is not None:
            return fixed, fixed
        slots = (s for s in self.layout.slots if (s.effect, s.parameter) == (effect, parameter))
        return next((s.bounds for s in slots), (-np.inf, np.inf))

    def position(self, effect: str, parameter: str, run: int | None = None) -> int | None:
        """Return the position in the layout of a parameter in one run; None if it is fixed, tied or absent."""
        for i, s in enumerate(self.layout.slots):
            if (s.effect, s.parameter) == (effect, parameter) and (run is None or s.run in (None, run)):
                return i
        return None

    # --- evaluation

    @cached_property
    def _whole(self) -> DataBlock:
        """All blocks as one."""
        return joined_blocks(self.blocks)

    def _blocks_of(self, g: int) -> Sequence[DataBlock]:
        """The blocks in which a group is evaluated: all as one if it is the same at all samples of equal motion."""
        alike = all(len(set(own[self.runs].tolist())) == 1 for own in self._sources[g].values())
        return [self._whole] if alike and len(self.blocks) > 1 and at_samples(self.groups[g].model) else self.blocks

    def columns(self, g: int, nonlinear_values: Array, steps: Array) -> Array:
        """Compute the columns of a group at level one, and their derivatives by its q non-linear parameters."""
        parts = []
        for block in self._evaluated[g]:
            places = self.places[g].reshape(-1, len(self.layout.run_names))[:, block.run]
            own = np.where(places < 0, 1.0, steps[places])
            moved = np.tile(nonlinear_values, (1 + len(places), 1))
            j = np.flatnonzero(places >= 0)
            moved[1 + j, places[j]] += own[j]
            made = self.rows_in(block, g, moved)
            made[1:] -= made[0]
            made[1:] /= own[:, None, None]
            parts.append(made)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)

    def rows(self, g: int, b: int, nonlinear_values: Array) -> Array:
        """Compute the rows (Q, k, m) of a group in one block for parameter vectors (Q, P), of a sinusoid in quadrature.

        Q is 1 if the group has no non-linear parameters.
        """
        return self.rows_in(self.blocks[b], g, nonlinear_values)

    def rows_in(self, block: DataBlock, g: int, nonlinear_values: Array) -> Array:
        """Compute the same rows in any block of the same runs."""
        group = self.groups[g]
        p = len(nonlinear_values) if group.nonlinear_slots else 1
        forward = block.picture if group.is_measurement else block.forward
        path = tiled_path(block.evaluation_path(group.model.memory), (1 + group.is_sinusoid) * p)
        if not group.is_sinusoid:
            columns = group.columns(path, self._values(g, block, nonlinear_values[:p]))
            return forward(columns.T.reshape(columns.shape[1], p, -1).transpose(1, 0, 2))
        effect = group.model.effects[0]
        values = self._values(g, block, nonlinear_values[:p].repeat(2, axis=0))[effect.name]
        phase = next(q.name for q in effect.nonlinear if q.role == "phase")
        values[phase] = np.tile(np.repeat(QUADRATURES, len(path.t) // (2 * p)), p)
        return forward(effect.columns(path, values).reshape(p, 2, -1))

    def loaded_columns(self, g: int) -> Mask:
        """Return which columns of a group carry the normal load, hence the friction level, of the run."""
        columns = [p.loaded for e in self.groups[g].model.effects for p in e.linear]
        return np.repeat(np.array(columns, dtype=bool), 1 + self.groups[g].is_sinusoid)

    def _values(self, g: int, block: DataBlock, nonlinear_values: Array) -> Values:
        """Non-linear values of a group along a block: one number, or one per sample where they differ."""
        layout, model = self.layout, self.groups[g].model
        values: Values = {effect: dict(own) for effect, own in self._fixed.items()}
        for (effect, name), of_run in self._sources[g].items():
            if of_run[block.run] >= 0:
                values[effect][name] = nonlinear_values[:, of_run[block.run]]
        if layout.constraints:
            apply_constraints(layout.model, tuple(r for r in layout.constraints if not r.parameter.linear), values)
        n = len(block.evaluation_path(model.memory).t)
        return {
            e.name: {q.name: repeat_values(values[e.name][q.name], n, q.role == "depth") for q in e.nonlinear}
            for e in model.effects
        }

    def weighted(self, g: int, coefficients: Array, columns: Array) -> Array:
        """Compute the data (..., M) that columns (..., k, M) of a group make with coefficients (K,)."""
        c, at = np.append(coefficients, 0.0), self.at[g]  # the last one for columns without a coefficient
        return c[at] @ columns if at.ndim == 1 else np.einsum("km,...km->...m", c[at], columns)

    # --- conversion to the unknowns of the layout

    def law(self, nonlinear_values: Array, coefficients: Array) -> Array:
        """Convert a separable solution to the unknowns of the layout."""
        p = np.array(nonlinear_values, dtype=float)
        estimates_by_slot: dict[int, list[float]] = {}
        pairs: dict[tuple[str, int | None], list[float]] = {}
        for c, value in zip(self.coefficients, coefficients, strict=True):
            if c.quadrature is not None:
                pairs.setdefault((c.effect, c.run), []).append(float(value))
            elif (i := self.position(c.effect, c.parameter, c.run)) is not None:
                estimates_by_slot.setdefault(i, []).append(float(value))
        for (effect, run), (a, b) in pairs.items():
            names: dict[str, str] = {
                q.role: q.name for e in self.layout.model.effects if e.name == effect for q in e.parameters
            }
            for role, value in (("amplitude", np.hypot(a, b)), ("phase", np.arctan2(b, a))):
                if (i := self.position(effect, names[role], run)) is not None:
                    estimates_by_slot.setdefault(i, []).append(float(value))
        for i, each in estimates_by_slot.items():
            p[i] = np.mean(each)
        return canonical_form(self.layout, p)
