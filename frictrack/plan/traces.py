"""What the law, the level and every effect leave in each run of the menu, whitened, its start removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.diagnose.experiments.virtual_runs import (
    GOLDEN_ANGLE_RAD,
    PLANNED_RUN_NAME,
    blank_piece,
    integrate_motion,
)
from frictrack.effects import Effect, Span
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse
from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.segments import Piece, spans_of
from frictrack.plan.causes import FRAMES, PICTURE, SHARE, Cause
from frictrack.plan.experiment_setup import Entry, Stand
from frictrack.records import Array

QUADRATURES = (0.0, np.pi / 2)
GONE = 1e-10  # share of a column's square below which it is rounding


@dataclass(frozen=True)
class Filmed:
    """One run of the menu under the assumed law: its response, sensitivities of law (n, P) and level (n,)."""

    entry: Entry
    response: PieceResponse
    problem: LeastSquaresProblem
    p: Array
    law: Array
    level: Array

    @property
    def piece(self) -> Piece:
        """The run as it would be measured, without noise."""
        return self.response.piece


def film_all(stand: Stand, entries: list[Entry]) -> list[Filmed]:
    """The runs of the menu that the assumed law lets be made."""
    made = []
    for entry in entries:
        try:
            made.append(_filmed(stand, entry))
        except FrictrackError:  # the mass would not get far enough
            continue
    if not made:
        raise FrictrackError(
            f"expected a course on which the mass can slide but on {stand.course:.2g} m at {stand.fps:g} frames/s no "
            "run of the menu is long enough to be judged; give a finer scale or a higher fps in [camera]"
        )
    return made


def _filmed(stand: Stand, entry: Entry) -> Filmed:
    fine = 3  # panels per frame, as a blow needs them
    piece = blank_piece(stand.bench, entry.film, 0, fine)
    wide = Span(1.0, stand.start, stand.start + stand.course, 0.01, 10.0, stand.fps)
    layout, p = _unknowns(stand, wide)
    piece = integrate_motion(LeastSquaresProblem(layout.model, layout, [piece]), p, entry.film)
    layout, p = _unknowns(stand, spans_of([piece], 1, stand.fps)[0])
    problem = LeastSquaresProblem(layout.model, layout, [piece])
    response = problem.evaluate(p, [np.array(entry.film.start)])[0]
    levels = layout.levels
    mine = [k for k, i in enumerate(response.active) if i not in levels]
    own = [k for k, i in enumerate(response.active) if i == levels[0]]
    return Filmed(entry, response, problem, p, response.jac[:, mine], response.jac[:, own[0]])


def _unknowns(stand: Stand, span: Span) -> tuple[ParameterLayout, Array]:
    """The law's unknowns with a level of the run's own: a second run, never filmed, is what gives it one."""
    layout = ParameterLayout(stand.law, (PLANNED_RUN_NAME, "another"), (span, span))
    p = [stand.values[s.effect][s.parameter] if s.effect in stand.values else 1.0 for s in layout.slots]
    return layout, np.array(p)


def columns(filmed: Filmed, cause: Cause, forms: tuple[dict[str, float], ...]) -> Array:
    """Whitened columns of an effect in one run, start removed, (n, G, k); phases as two quadratures."""
    effect, response = cause.effect, filmed.response
    phases = [q.name for q in effect.nonlinear if q.role == "phase"]
    turned = [dict.fromkeys(phases, q) for q in QUADRATURES] if phases else [{}]
    length = float(response.piece.t[-1])
    each = [_inside(cause, form, length) | phase for form in forms for phase in turned]
    moved_by = _picture(filmed, effect, each) if effect.acts_on == "measurement" else _moved(filmed, effect, each)
    white = moved_by / response.piece.sigma[:, None]
    white -= response.q @ (response.q.T @ white)
    return np.asarray(white.reshape(len(white), len(forms), -1))


def _inside(cause: Cause, form: dict[str, float], length: float) -> dict[str, float]:
    """A form whose moment stands as a share of the run's duration, in s."""
    if not cause.event:
        return form
    return form | {p.name: form[p.name] * length for p in cause.effect.nonlinear if p.per_run and p.scan is not None}


def _picture(filmed: Filmed, effect: Effect, forms: list[dict[str, float]]) -> Array:
    motion, piece = filmed.response.motion, filmed.piece
    path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], 1.0)
    return np.concatenate([effect.columns(path, form) for form in forms], axis=1)


def forces(filmed: Filmed, effect: Effect, forms: list[dict[str, float]]) -> Array:
    """N at the nodes of a run, (3 p, G k); of a modifier what it changes."""
    motion, piece = filmed.response.motion, filmed.piece
    path = piece.path_at_nodes(motion.x, motion.v, 1.0)
    if not effect.modifies:
        return np.concatenate([effect.columns(path, form) for form in forms], axis=1)
    values, _ = filmed.problem.layout.values(filmed.p, 0)
    model = filmed.problem.model
    there = model.force_columns(path, values)
    inner = sum(there[e.name] @ model.coefficients(e.name, values) for e in model.effects if e.kind in effect.modifies)
    dry = np.asarray(inner)[:, None]
    return np.concatenate([effect.columns(path, form, dry) - dry for form in forms], axis=1)


def _moved(filmed: Filmed, effect: Effect, forms: list[dict[str, float]]) -> Array:
    g = -forces(filmed, effect, forms) / filmed.piece.mass
    _, edges = filmed.response.linear.respond(g, np.zeros((2, g.shape[1])))
    return np.asarray(edges[filmed.piece.at, 0])


def amplitude(runs: list[Filmed], cause: Cause) -> float:
    """The coefficient at which a cause has its stated size over the runs of the menu."""
    effect, setting = cause.effect, cause.setting
    if effect.name == "dropped_frame":
        return FRAMES
    if effect.name == "collision":
        return SHARE * float(np.median([r.piece.mass * abs(r.entry.film.start[1]) for r in runs]))
    if effect.acts_on == "measurement":
        shifts = [_picture(r, effect, [setting])[:, 0] / r.piece.sigma for r in runs]
        return PICTURE / max(_rms(shifts), 1e-300)
    if not effect.sized:
        return 1.0
    made = [forces(r, effect, [setting])[:, 0] for r in runs]
    usual = [r.piece.mass * (r.piece.known - r.response.motion.a) for r in runs]
    return SHARE * float(np.mean(np.abs(np.concatenate(usual)))) / max(_rms(made), 1e-300)


def _rms(parts: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def trace(filmed: Filmed, cause: Cause, size: float, number: int) -> Array:
    """What a true cause of that size leaves in one run, (n,); phases of the runs spread evenly."""
    block = columns(filmed, cause, (_moment(cause, number),))[:, 0]
    if any(q.role == "phase" for q in cause.effect.nonlinear):
        phase = GOLDEN_ANGLE_RAD * number if has_per_run_coefficients(cause.effect) else 0.5
        return size * np.asarray(block[:, 0] * np.cos(phase) + block[:, 1] * np.sin(phase))
    return size * np.asarray(block[:, 0])


def _moment(cause: Cause, number: int) -> dict[str, float]:
    """The setting of a cause, an event at another moment in every run: shares of its duration."""
    if not cause.event:
        return cause.setting
    share = 0.3 + 0.4 * ((0.618 * (number + 1)) % 1.0)
    return cause.setting | {p.name: share for p in cause.effect.nonlinear if p.per_run and p.scan is not None}
