"""Cut runs into the pieces that a model can be followed along: one direction each, or longer where it can reverse.

Unmodelled forces are integrated twice and soon exceed the camera's noise. A new piece forgets them, at the price of
its own start position and speed. So where the drive is measured, the length of the pieces is chosen. For several
lengths the model is solved by linear least squares along the measured motion. With H the information and e the
significant excess of chi-squared per piece, the covariance of the coefficients is at most about

    (1 + e) H^-1

because the excess of a piece may all point along one coefficient (Cauchy-Schwarz; the usual sandwich with every
residual in the worst direction). The length with the smallest determinant is taken: the whole run if there is no
excess. A long record with reversals is cut into pieces of `REVERSAL_PIECE_FRAMES` frames, each with its memory of the
motion before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np
from scipy.interpolate import CubicSpline

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Path, Span
from frictrack.effects.models import Model
from frictrack.fit.pieces import (
    Piece,
    Rows,
    column_norms,
    cut_rows,
    displacement_rows,
    motion_before,
    panel_edges,
    spans_of,
    without_starts,
)
from frictrack.measure.calibration import significant_motion
from frictrack.measure.friction import (
    MIN_MOTION_SIGMAS,
    MIN_MOVING_SIGMAS,
    drive_noise,
    free_section,
    is_moving,
    join_swings,
    moving_sections,
    release_time,
)
from frictrack.measure.motion import CorrelatedNoise, NoiseStretch, correlated_noise
from frictrack.records import GRAVITY, Array, Mask, Run
from frictrack.sampling import noise_level, unusual_steps
from frictrack.simulate.dynamics import Panels

MIN_NOISE_OF_TRAVEL = 1e-9  # motions are solved to 1e-13 m, and singular values of 1e-8 are the last that count
OWN_NOISE_OF_SPEEDS = 0.1  # of that of a step; positions that are integrated from speeds have none
MIN_FRAMES = 8  # fewer leave no information beyond start position and speed
MIN_SHARE_OF_LAST_SPEED = 0.5  # to which a swing is followed that comes to rest
MIN_KNOWN_SHARE = 0.5  # least share of frames in which a series is known
MAX_REST_SPEED_SHARE = 0.1  # share of the highest speed; a certainly slower beginning is rest

_NOISE: WeakKeyDictionary[Run, NoiseStretch] = WeakKeyDictionary()  # the last one of a run: every model asks for it
MIN_PIECE_FRAMES = 2 * MIN_FRAMES  # frames; in shorter pieces the start uses up a quarter of the information
EXCESS_STD = 2.33  # standard deviations of chi-squared: one-sided 1 % level
LOG_CERTAIN = float(np.log(100.0))  # ratio of likelihoods from which a drive is exact: alpha = 1 %
MIN_SINGULAR_VALUE = 1e-6  # relative; smaller singular values are left out
REVERSAL_PIECE_FRAMES = 512  # frames; computing time grows faster than the length
MIN_HISTORY_FRAMES = 100  # first frames of a record without known history; they determine the states of memory
SCAN_QUANTILES = (0.25, 0.5, 0.75)  # quantiles of a scan at which a non-linear parameter is held


@dataclass(frozen=True)
class Reference:
    """Mass (kg) and normal load (N) at which newtons are reported."""

    mass: float
    load: float


def reference_of(runs: Sequence[Run], mass: float | None = None) -> Reference:
    """Return the mass and the normal load at which newtons are reported: those of the first run, if none is given.

    The load is 1 where the mass is unknown.
    """
    first = runs[0]
    if first.mass is None:
        return Reference(mass or 1.0, 1.0)
    mass = mass or first.mass
    return Reference(mass, first.normal_load or mass * GRAVITY * float(np.cos(first.straight_incline)))


@dataclass(frozen=True)
class RunContext:
    """What the pieces of one run share: reference, release time (s), smoothed motion and drive since release."""

    reference: Reference
    release: float
    way: Array  # t, x, v (3, k)
    slid: Array  # m since release, (k,)
    angle: Array | None  # rad, per frame; the significant part
    motion_at: CubicSpline  # x and v (m, 2)
    drive_at: Callable[[Array], Array] | None  # N


def pieces_of(runs: Sequence[Run], reference: Reference, *, through_reversals: bool = False) -> list[list[Piece]]:
    """Cut every run into pieces of one direction, of at least `MIN_FRAMES` frames.

    Where the noise is not stated, its correlation between neighbouring frames is estimated from all runs together.

    Parameters
    ----------
    runs : sequence of Run
        The runs.
    reference : Reference
        Mass and load at which newtons are reported. An unknown mass is counted in units of the reference mass.
    through_reversals : bool
        Whether the model can pass stops and reversals. A run with a measured drive is then one piece.

    Returns
    -------
    list of list of Piece
        The pieces of every run, in order of time.

    Raises
    ------
    FrictrackError
        If a run has neither mass nor drive, or no usable part.

    """
    pieces = [_pieces_of_run(run, i, reference, through_reversals) for i, run in enumerate(runs)]
    # where the noise is neither stated nor due to rounding
    shown = [not (run.noise or run.displacement.resolution or run.displacement.sigma_v) for run in runs]
    estimated = np.flatnonzero(shown).tolist()
    found = correlated_noise([_noise_stretch(runs[i], _longest_gapless(pieces[i])) for i in estimated])
    if found is not None:
        for i, rms in zip(estimated, found.rms.tolist(), strict=True):
            pieces[i] = [_with_correlated_noise(p, found, rms) for p in pieces[i]]
    return [_with_errors_of_drive(run, own) for run, own in zip(runs, pieces, strict=True)]


def _pieces_of_run(run: Run, index: int, reference: Reference, through_reversals: bool) -> list[Piece]:
    if run.mass is None and run.drive is None:
        raise FrictrackError(f'run "{run.name}": expected a mass for a fit of the displacement but got none')
    spans = moving_sections(run)
    if through_reversals and run.drive is not None and sum(s.stop - s.start >= MIN_FRAMES for s in spans) > 1:
        return [whole_piece(run, index, reference)]
    context, noise = run_context(run, reference), _noise_of(run)
    made = []
    for span, gain in join_swings(run, spans):
        rows = np.arange(span.start, _until_it_stops(run.motion.v, span) if gain else span.stop)
        rows = rows[run.displacement.valid[rows] & np.isfinite(run.displacement.x[rows])]
        if len(rows) >= MIN_FRAMES:
            piece = _piece(run, index, rows, noise, context)
            made.append(replace(piece, turns=True, gain=gain) if gain else piece)
    if not made:
        raise FrictrackError(
            f'run "{run.name}": expected at least {MIN_FRAMES} free frames in one direction but found none; '
            "look at its velocity, or give free = [t0, t1]"
        )
    return made


def _until_it_stops(v: Array, span: slice) -> int:
    """End of the frames of a swing in which its last stretch has not lost half of its highest speed.

    Where the mass comes to rest under a law, another law near it would let it turn once more, or rest earlier.
    """
    turns = np.flatnonzero(np.diff(np.sign(v[span]))) + 1
    last = span.start + (int(turns[-1]) if len(turns) else 0)
    speed = np.abs(v[last : span.stop])
    fast = np.flatnonzero(speed >= MIN_SHARE_OF_LAST_SPEED * np.max(speed))
    return last + int(fast[-1]) + 1


def whole_piece(run: Run, index: int, reference: Reference) -> Piece:
    """Return one piece over the whole record, or the given free section, of a driven run; else over the free section.

    A driven one begins at rest where its first frame does: its direction is then 0.
    """
    free, x, t = free_section(run)[0], run.displacement.x, run.displacement.t
    use = (free if run.drive is None else run.displacement.valid) & np.isfinite(x)
    if run.drive is not None and run.free is not None:
        use &= (t >= run.free[0]) & (t <= run.free[1])
    rows = np.flatnonzero(use)
    piece = _piece(run, index, rows, _noise_of(run), run_context(run, reference))
    if run.drive is None:
        return piece
    first = np.sign(run.motion.v[rows[0]]) if is_moving(run)[rows[0]] else 0.0
    return replace(piece, turns=True, path=replace(piece.path, s=np.full_like(piece.path.t, first)))


def _piece(run: Run, index: int, rows: Rows, noise: Array, context: RunContext) -> Piece:
    """The piece of some rows of a run."""
    mass = float(run.inertia or context.reference.mass)
    t, times = run.displacement.t[rows] - context.release, run.motion.t - context.release
    edges, at = panel_edges(t, 1)
    panels = Panels(edges)
    path = path_of_rows(run, rows, panels.t, context)
    x_hat, v_hat = np.ascontiguousarray(context.motion_at(panels.t).T)
    drive = np.zeros_like(panels.t) if path.drive is None else path.drive
    return Piece(
        run=index,
        frames=rows,
        t=t,
        y=run.displacement.x[rows],
        sigma=noise[rows],
        panels=panels,
        at=at,
        per_frame=1,
        x_hat=x_hat,
        v_hat=v_hat,
        a_hat=np.interp(panels.t, times, run.motion.a),
        known=drive / mass + run.pull,
        path=path,
        mass=mass,
        way=context.way,
        angle=_interpolated(times, context.angle, t),
        walk=run.displacement.sigma_v**2 * float(np.median(np.diff(run.displacement.t))),
        systematic=float(np.hypot(run.displacement.systematic, run.drift or 0.0)),
        step=run.displacement.resolution,
        clock_error=run.displacement.clock_error,
        shake=run.displacement.shake,
        locked=_pixel_locked_share(run, rows, noise),
    )


def path_of_rows(run: Run, rows: Rows, nodes: Array, context: RunContext) -> Path:
    """Create the path of a piece of some rows of a run at its nodes (m,), s since release; its x and v are zero."""
    motion = run.motion
    times = motion.t - context.release
    still = np.zeros_like(nodes)
    before = motion_before(context.way, run.displacement.t[rows[0]] - context.release)
    row = max(before.shape[1] - 1, 0)
    return Path(
        t=nodes,
        x=still,
        v=still,
        s=still + np.sign(np.median(motion.v[rows])),
        load=1.0 if run.mass is None else (run.load or 1.0) / context.reference.load,
        mass_ratio=float(run.mass or context.reference.mass) / context.reference.mass,
        mass=run.mass,
        pixel_pitch=run.pixel_pitch,
        drive=None if context.drive_at is None else context.drive_at(nodes),
        drive_at=context.drive_at,
        lift=CubicSpline(times, motion.a_y)(nodes) if np.all(np.isfinite(motion.a_y)) else None,
        gravity=GRAVITY * float(np.cos(run.straight_incline)) if run.mass is None else (run.load or 1.0) / run.mass,
        curvature=1 / run.radius if run.radius and run.normal_load is None else 0.0,
        lowest=-run.incline * run.radius if run.radius and run.has_incline else np.nan,
        angle=_interpolated(times, context.angle, nodes),
        clamp_x=run.clamp_x,
        beam_length=run.beam_length,
        earlier=None if run.earlier is None else (run.earlier,),
        travelled=float(context.slid[row]),
        begins=float(context.way[1, row]),
        before=before,
    )


def _clamped(series: CubicSpline, t: Array) -> Array:
    """Values of an interpolant that keeps its first and last value outside the known times."""
    return np.asarray(series(np.clip(t, series.x[0], series.x[-1])))


def _interpolated(times: Array, series: Array | None, t: Array) -> Array | None:
    return None if series is None else np.interp(t, times, series)


def run_context(run: Run, reference: Reference) -> RunContext:
    """Compute what the pieces of a run share.

    A run that was seen at rest first begins with that rest, so that effects with memory start without history.
    """
    release, motion, moves = release_time(run), run.motion, is_moving(run)
    since, way = motion.t >= release, np.stack([motion.t - release, motion.x, motion.v])
    if rest := _frames_at_rest(run):
        way[1:, :rest] = np.array([[np.mean(motion.x[:rest])], [0.0]])
        since[:rest] = True
    way = way[:, since]
    slid = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(way[1])) * moves[since][1:])])  # no steps at rest
    if rest:  # the rest began before the record
        way = np.column_stack([[2 * way[0, 0] - way[0, 1], way[1, 0], 0.0], way])
        slid = np.append(0.0, slid)
    times, angle = motion.t - release, _significant_angle(motion.t, run.displacement.angle)
    motion_at = CubicSpline(times, np.column_stack([motion.x, motion.v]))
    drive_at = None if run.drive is None else partial(_clamped, CubicSpline(times, run.drive))
    return RunContext(reference, release, way, slid, angle, motion_at, drive_at)


def _frames_at_rest(run: Run) -> int:
    """Number of frames at the beginning of a record in which a free mass rests; 0 if it slides from the first one."""
    # If the smoothed motion is never certainly slow, only the first frame is tested. With a load cell a mass may rest
    # under any force, so no frame counts as rest.
    if run.friction_N is not None:
        return 0
    v, sigma = run.motion.v, run.motion.sigma_v
    certain = np.abs(v) > MIN_MOTION_SIGMAS * sigma
    resting = np.flatnonzero(~is_moving(run)[: int(np.argmax(certain))])
    rows = resting if len(resting) else np.array([0])
    error = float(np.sqrt(np.mean(sigma[rows] ** 2) / len(rows)))
    at_most = abs(float(np.mean(v[rows]))) + MIN_MOVING_SIGMAS * error
    rests = at_most < MAX_REST_SPEED_SHARE * float(np.max(np.abs(v[certain]), initial=0.0))
    return int(rows[-1]) + 1 if rests else 0


def _significant_angle(times: Array, angle: Array) -> Array | None:
    """The significant part of the target's angle (n,), gaps interpolated; None if most of it is unknown."""
    # Angle and place of one frame come from the same pixels, so the noise of the angle is correlated with that of the
    # place. An angle that does not exceed its noise counts as constant zero.
    known = np.isfinite(angle)
    if np.mean(known) <= MIN_KNOWN_SHARE:
        return None
    bridged = np.interp(times, times[known], angle[known])
    middle = float(np.mean(bridged))
    turned = significant_motion(bridged - middle, times)[0]
    return middle + turned if turned.any() else turned


def _noise_of(run: Run) -> Array:
    """Standard deviation of the noise (n,), m: as stated, else estimated; the tracker's own are relative weights."""
    disp = run.displacement
    if disp.sigma_v:
        return OWN_NOISE_OF_SPEEDS * disp.sigma_x
    use = free_section(run)[0] & disp.valid
    relative = _relative_noise(disp.sigma_x, use)
    white = noise_level(disp.x, use, relative, disp.t)[0]
    return relative * (run.noise or max(white, _least_noise(run), disp.resolution / float(np.sqrt(12.0))))


def _relative_noise(sigma: Array, use: Mask) -> Array:
    """The tracker's standard deviations as relative weights: 1 in the median frame, 1 where not stated."""
    known = np.isfinite(sigma) & (sigma > 0) & use
    return np.where(known, sigma / np.median(sigma[known]), 1.0) if known.any() else np.ones(len(sigma))


def _least_noise(run: Run) -> float:
    """The least noise of the positions of a run that a fit can use, m: fitted motions are not more accurate."""
    x = run.displacement.x[run.displacement.valid]
    return MIN_NOISE_OF_TRAVEL * float(np.nanmax(x) - np.nanmin(x))


def noise_free_remark(runs: Sequence[Run]) -> Iterator[str]:
    """Yield a sentence about runs whose positions have no noise, as computed ones."""
    free = [
        run.name
        for run in runs
        if run.noise is None
        and not run.displacement.resolution  # rounded positions at rest are equal
        and noise_level(run.displacement.x, run.displacement.valid, t=run.displacement.t)[0] < _least_noise(run)
    ]
    if free:
        yield (
            f"the positions of {', '.join(free)} have no noise, as if they were computed; a noise of "
            f"{MIN_NOISE_OF_TRAVEL:g} of the travel is assumed, and the standard deviations do not tell how well a "
            "measurement determines the parameters"
        )


def _pixel_locked_share(run: Run, rows: Rows, noise: Array) -> float:
    """Share of the measured variance of a film beyond what its tracker states; 0 for a table."""
    if not run.displacement.systematic or not run.pixel_pitch:
        return 0.0
    stated = run.displacement.sigma_x[rows] / run.displacement.raised
    return max(0.0, 1 - float(np.mean(stated**2) / np.mean(noise[rows] ** 2)))


def _noise_stretch(run: Run, positions: Array) -> NoiseStretch:
    """The positions of a run with their noise, those of an earlier fit if they are the same."""
    known = _NOISE.get(run)
    if known is None or not np.array_equal(known.positions, positions):
        known = _NOISE[run] = NoiseStretch(positions)
    return known


def _longest_gapless(pieces: Sequence[Piece]) -> Array:
    """Measured positions of the longest part of a run without a missing frame, or another interval."""
    gaps = [(np.diff(p.frames) != 1) | unusual_steps(p.t) for p in pieces]
    parts = [part for p, gap in zip(pieces, gaps, strict=True) for part in np.split(p.y, np.flatnonzero(gap) + 1)]
    return max(parts, key=len)


def _with_correlated_noise(piece: Piece, found: CorrelatedNoise, rms: float) -> Piece:
    """The same piece with noise of `rms` (m) that is correlated between neighbouring frames."""
    time = -float(np.median(np.diff(piece.t))) / float(np.log(found.correlation))
    level = rms * float(np.sqrt((1 - found.share) / np.mean(piece.sigma**2)))
    return replace(piece, sigma=level * piece.sigma, correlated=(rms * float(np.sqrt(found.share)), time))


def _with_errors_of_drive(run: Run, pieces: list[Piece]) -> list[Piece]:
    """The same pieces of a run, pushed by the errors of its drive: as stated, else its scatter.

    A scatter is no error where the motion certainly follows it: where it is noise, a likelihood ratio above 1/alpha in
    favour of the exact drive has at most the probability alpha (Ville 1939).
    """
    sigma = drive_noise(run)
    if not sigma:
        return pieces

    def pushed(some: Sequence[Piece]) -> list[Piece]:
        return [replace(p, push=(sigma / p.mass) ** 2 * (run.drive_interval or np.median(np.diff(p.t)))) for p in some]

    if run.sigma_drive is not None:
        return pushed(pieces)
    exact = pieces if run.mass else [p.in_mass_units(guess_mass(pieces)) for p in pieces]
    noisy, rows = pushed(exact), [_smooth_law(p) for p in exact]
    keep = _distinguishable_directions(rows, exact)
    likelier = _log_likelihood(exact, rows, keep) - _log_likelihood(noisy, [_smooth_law(p) for p in noisy], keep)
    return pieces if likelier > LOG_CERTAIN else pushed(pieces)


def _smooth_law(piece: Piece) -> Array:
    """Rows as of `_linear_model` for a friction that any smooth law of speed, place and time could have."""
    t, x, v = piece.panels.t, piece.x_hat, np.abs(piece.v_hat)
    s, top = piece.direction(piece.v_hat), float(np.max(v)) or 1.0
    forces = [s, *(s * np.exp(-v / (share * top)) for share in SCAN_QUANTILES), s * v, s * v**2, x, t, np.ones_like(t)]
    forces += [piece.path.drive] if piece.path.mass is None and piece.path.drive is not None else []
    return displacement_rows(piece, np.column_stack(forces))


def _log_likelihood(pieces: Sequence[Piece], rows: Sequence[Array], keep: Array) -> float:
    """Restricted log-likelihood of whitened rows, their starts and coefficients free (Patterson & Thompson 1971)."""
    total, rest = 0.0, []
    for piece, own in zip(pieces, rows, strict=True):
        start = piece.whitened(np.column_stack([np.ones_like(piece.t), piece.t - piece.t.mean()]))
        both = np.column_stack([start, own[:, :-1] @ keep, own[:, -1]])
        upper: Array = np.asarray(np.linalg.qr(both, mode="r"))
        total -= float(np.sum(np.log(piece.whitening.size)) + np.sum(np.log(np.abs(np.diag(upper)[:2]))))
        rest.append(upper[2:, 2:])
    *free, left = np.abs(np.diag(np.linalg.qr(np.concatenate(rest), mode="r")))
    return total - float(np.sum(np.log(free))) - 0.5 * float(left) ** 2


def guess_mass(pieces: Sequence[Piece]) -> float:
    """Guess the mass, kg, by least squares of the smoothed acceleration on drive, direction and speed.

    If drive and acceleration are not positively related, it is the ratio of their sizes.
    """
    drive = np.concatenate([np.zeros_like(p.known) if p.path.drive is None else p.path.drive for p in pieces])
    undriven = np.concatenate([p.in_mass_units(np.inf).known for p in pieces])  # gravity along the track
    acceleration = np.concatenate([p.a_hat for p in pieces]) - undriven
    regressors = np.concatenate([np.column_stack([p.path.s, p.v_hat]) for p in pieces])
    inverse = float(np.linalg.lstsq(np.column_stack([drive, regressors]), acceleration, rcond=1e-10)[0][0])
    if inverse > 0 and np.isfinite(inverse):
        return 1.0 / inverse
    return float(np.sqrt(np.mean(drive**2) / np.mean(acceleration**2))) or 1.0


def piece_frames(model: Model, pieces: Sequence[Piece], run: Run) -> int:
    """Choose the number of frames per piece of one run from its longest possible `pieces`; 0 leaves these whole."""
    whole = max(len(p.t) for p in pieces)
    if any(p.gain for p in pieces):  # friction of a swinging mass follows from the loss over many swings
        return 0
    if any(p.turns for p in pieces):
        return REVERSAL_PIECE_FRAMES if whole > 2 * REVERSAL_PIECE_FRAMES else 0
    lengths = [0, *(n for n in (whole >> k for k in range(1, 32)) if n >= MIN_PIECE_FRAMES)]
    if run.drive is None or len(lengths) == 1 or not any(_is_known_before_fit(e) for e in model.effects):
        return 0
    rows = [_linear_model(model, p) for p in pieces]
    keep = _distinguishable_directions(rows, pieces)
    rows = [np.column_stack([r[:, :-1] @ keep, r[:, -1]]) for r in rows]
    relative_noise_error = noise_level(run.displacement.x, run.displacement.valid, t=run.displacement.t)[1]
    return min(lengths, key=lambda n: _log_covariance(rows, pieces, n, relative_noise_error))


def cut_into_pieces(pieces: Sequence[Piece], n: int) -> list[Piece]:
    """Cut pieces of one run into shorter ones of about n frames; 0 leaves them whole."""
    if not n:
        return list(pieces)
    out = []
    for piece in pieces:
        first = MIN_HISTORY_FRAMES if piece.turns and not piece.gain and _history_is_unknown(piece) else 0
        cuts = [c + first for c in cut_rows(len(piece.t) - first, n)]
        out += [replace(piece.part(int(c[0]), int(c[-1]) + 1), cut=True) for c in cuts]
    return out


def has_known_history(piece: Piece) -> bool:
    """Return whether a piece begins at rest, or after enough motion to determine the states of effects with memory."""
    before = piece.path.before
    return bool(piece.path.s[0] == 0 or (before is not None and before.shape[1] >= MIN_HISTORY_FRAMES))


def _history_is_unknown(piece: Piece) -> bool:
    """Whether a piece moves from its first frame on and nothing is known of the motion before."""
    before = piece.path.before
    return bool(piece.path.s[0] != 0 and (before is None or before.shape[1] < 2))


def _linear_model(model: Model, piece: Piece) -> Array:
    """Displacement per unit coefficient, and measured minus known displacement last, (n, K + 1), in units of sigma."""
    nodes = piece.path_at_nodes(piece.x_hat, piece.v_hat, 1.0)
    span = spans_of([replace(piece, run=0)], 1, 1 / float(np.median(np.diff(piece.t))))[0]
    forces = [
        e.columns(nodes, held) for e in model.effects if _is_known_before_fit(e) for held in _values_before_fit(e, span)
    ]
    return displacement_rows(piece, np.column_stack(forces))


def _is_known_before_fit(effect: Effect) -> bool:
    """Whether the columns of an effect along the measured motion are known well enough before the fit."""
    return effect.acts_on == "force" and not effect.modifies and not any(p.role == "phase" for p in effect.parameters)


def _values_before_fit(effect: Effect, span: Span) -> list[dict[str, float]]:
    """Values of the non-linear parameters: fixed ones, and others at three quantiles of their scan."""
    each = [
        [p.fixed] if p.fixed is not None else list(np.quantile(p.scan(span), SCAN_QUANTILES)) if p.scan else [0.0]
        for p in effect.nonlinear
    ]
    return [dict(zip((p.name for p in effect.nonlinear), point, strict=True)) for point in product(*each)]


def _distinguishable_directions(rows: Sequence[Array], pieces: Sequence[Piece]) -> Array:
    """Combinations (K, K') of the coefficients that the run can distinguish."""
    jac = np.concatenate([without_starts(p, r[:, :-1])[0] for p, r in zip(pieces, rows, strict=True)])
    norm = column_norms(jac)
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    return np.asarray(vt[s > MIN_SINGULAR_VALUE * s[0]].T / norm[:, None])


def _log_covariance(rows: Sequence[Array], pieces: Sequence[Piece], n: int, relative_noise_error: float) -> float:
    """Logarithm of the determinant of the coefficients' covariance with pieces of n frames."""
    blocks = [window for own, piece in zip(rows, pieces, strict=True) for window in without_starts(piece, own, n)]
    # QR, because normal equations lose chi-squared to rounding where the displacement is large
    upper = np.abs(np.diag(np.linalg.qr(np.concatenate(blocks), mode="r")))
    k = len(upper) - 1  # the last column is the data: what is left of it is chi-squared
    degrees = sum(len(b) for b in blocks) - 2 * len(blocks) - k
    excess = excess_chi2(float(upper[k] ** 2), degrees, len(blocks), relative_noise_error)
    return k * float(np.log1p(excess)) - 2.0 * float(np.sum(np.log(np.maximum(upper[:k], 1e-300))))


def excess_chi2(chi2: float, degrees: int, pieces: int, relative_noise_error: float) -> float:
    """Compute the excess of chi-squared beyond its 99 % quantile, per piece; 0 if there is none.

    Examples
    --------
    >>> excess_chi2(100.0, 100, 4, 0.0)
    0.0

    """
    threshold = degrees + EXCESS_STD * float(np.sqrt(2 * degrees + (2 * relative_noise_error * degrees) ** 2))
    return max(chi2 - threshold, 0.0) / pieces
