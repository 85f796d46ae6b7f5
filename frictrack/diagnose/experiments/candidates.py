"""List the runs that could be filmed: before the first film as assumed, and after it as runs have shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated

import numpy as np

from frictrack.base.arguments import checked
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_plain
from frictrack.diagnose.experiments.virtual_runs import DEFAULT_SCATTER, RunConditions, RunDesign, max_frames_of_film
from frictrack.effects import Path, models
from frictrack.effects.models import Model
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.records import GRAVITY
from frictrack.settings.costs import DEFAULT_COSTS, SAME_RATIO, Costs

SLOWER_FACTOR, FASTER_FACTOR = 0.5, 1.5  # times the slowest and the fastest run so far
TILT_RAD = np.deg2rad(5.0)
MIN_SPEED_DIFFERENCE = 0.15  # relative; smaller ones count as the same speed
STOP_WITHIN_SHARE = 0.8  # of the course
SPEED_KEYS = ("slower", "faster", "to a stop", "repeat")  # whose speeds are combined with mass and direction
PICTURE_WIDTH_PX = 800  # width of a picture, px
DEFAULT_NOISE_PX = 0.02  # position noise per frame, px
SPEEDS_M_S = (1.0, 2.0, 4.0, 6.0, 8.0)
RETURN_SPEEDS_M_S = (2.0, 4.0, 8.0)  # in the other direction
MIDDLE_SPEED_M_S = 4.0  # at which mass, tilt and frame rate are varied
PLANNED_STOP_SHARE = 0.85  # of the course, within which a mass of typical friction is to stop
COULOMB_DECELERATION = 5.0  # m/s^2
STATIC_RISE_RATIO = 0.3  # static over Coulomb friction, minus one
STRIBECK_VELOCITY = 0.3  # m/s
VISCOUS_RATIO = 0.1  # viscous friction per m/s, over Coulomb friction


def _plain_run(course: tuple[float, float], velocity: float, frames: float, drive: float = 1.0) -> RunDesign:
    """Design of a run over the whole course; negative velocities, m/s, go the other way."""
    return RunDesign((course[0] if velocity > 0 else course[1], velocity), course, drive=drive, frames=frames)


def _speed_to_stop(deceleration: float, distance: float) -> float:
    """Speed, m/s, from which a mass stops within a distance, m."""
    return float(np.sqrt(2 * deceleration * distance))


def _changed_runs(plain: RunDesign, other_mass: str, otherwise: str) -> Iterator[RunDesign]:
    """List a plain run with another mass, a tilted course, and more frames per second; two sentences have a gap."""
    yield plain.changed("double mass", other_mass.format("with the mass doubled"), mass=2.0)
    yield plain.changed("half mass", other_mass.format("with half the mass"), mass=0.5)
    for sign, word in ((1.0, "raised"), (-1.0, "lowered")):
        tilted = f"with the far end of the course {word} by 5 degrees (give incline)"
        yield plain.changed(f"tilt {sign:+.0f}", otherwise.format(tilted), tilt=sign * TILT_RAD)
    faster = "at twice the frame rate, as long as the light allows"
    yield plain.changed("frame rate", otherwise.format(faster), rate=2.0)


def candidate_experiments(
    solution: Solution, costs: Costs = DEFAULT_COSTS, *, combined: bool = False
) -> list[RunDesign]:
    """List runs that could be filmed next, within what the set-up has shown in a fit of its runs.

    Slower, faster, to a stop, reversed, repeated; other mass, tilt, frame rate, zoom and length. With `combined`, runs
    that combine speed, direction and mass follow.
    """
    pieces, span = solution.problem.pieces, solution.problem.layout.span
    starts = dict(reversed([(p.run, float(s[1])) for p, s in zip(pieces, solution.starts, strict=True)]))
    velocities, course = list(starts.values()), (span.x_min, span.x_max)
    a = np.concatenate([r.piece.path.s * r.motion.a for r in solution.responses])
    what = "Drive and film" if any(p.path.drive is not None for p in pieces) else "Film"
    frames, typical = max_frames_of_film(solution, costs), float(np.median(np.abs(velocities)))
    direction = 1.0 if np.sum(np.sign(velocities)) >= 0 else -1.0

    def design(speed: float, sign: float = 1.0) -> RunDesign:
        """A plain run at a speed, in the direction of most runs or (sign -1) in the other."""
        return _plain_run(course, sign * direction * speed, frames, sign * speed / typical)

    def speed_changes(low: float, high: float) -> Iterator[RunDesign]:
        slowest, fastest = min(map(abs, velocities)), max(map(abs, velocities))
        slow, fast = max(SLOWER_FACTOR * slowest, low), min(FASTER_FACTOR * fastest, high)
        if slow < (1 - MIN_SPEED_DIFFERENCE) * slowest:
            yield design(slow).changed("slower", f"{what} a slower run, at about {slow:.1f} m/s")
        if fast > (1 + MIN_SPEED_DIFFERENCE) * fastest:
            yield design(fast).changed("faster", f"{what} a faster run, at about {fast:.1f} m/s")
        stop = _speed_to_stop(max(-float(np.median(a)), 0.1), STOP_WITHIN_SHARE * (course[1] - course[0]))
        if what == "Film" and low < stop < high:  # a drive would go on
            words = f"{what} a run until the mass stops by itself, released at about {stop:.1f} m/s"
            yield design(stop).changed("to a stop", words)
        turned = len(set(np.sign(velocities).tolist())) > 1
        text = "the other way" if turned else "in the other direction, which no run has had so far,"
        yield design(typical, -1.0).changed("reversed", f"{what} a run {text} at about {typical:.1f} m/s")
        yield design(typical).changed("repeat", f"{what} another run like those at about {typical:.1f} m/s")

    plain, run, at = design(typical), f"{what} a run", f"at about {typical:.1f} m/s"
    entries = [*speed_changes(*costs.speeds), *_changed_runs(plain, f"{run} {{}}, {at}", f"{run} {at} {{}}")]
    longer = f"{what} a longer run: half as far again, {at}, the camera moved back"
    for key, pitch, text in (
        ("zoom", 0.7, f"{run} {at} at another zoom, a pixel being 0.7 times as large"),
        ("longer", 1.5, longer),
    ):
        begin, way = plain.start[0], pitch * (course[1] - course[0])
        low, high = sorted((begin, begin + plain.direction * way))
        entries.append(plain.changed(key, text, pitch=pitch, course=(low, high)))
    if not combined:
        return entries
    mass = RunConditions.of_fit(solution).mass
    ratios = [one / mass for one in costs.masses] or [1.0, 2.0]
    speeds = {abs(e.start[1]) for e in entries if e.key in SPEED_KEYS}
    known = set(entries)
    for speed, sign, ratio in product(sorted(speeds), (1, -1), ratios):
        other = replace(design(speed, sign), mass=1.0 if abs(ratio - 1) < SAME_RATIO else ratio)
        if other not in known:
            load = "" if other.mass == 1 else f" with {mass * ratio:.3g} kg"
            words = f"{run}{'' if sign > 0 else ' the other way'} at about {speed:.1f} m/s{load}"
            entries.append(other.changed(f"{other.start[1]:.1f} m/s{load}", words))
    return entries


@dataclass(frozen=True)
class ExperimentSetup:
    """Values on which a plan rests.

    Parameters
    ----------
    mass
        Mass of the slider, kg.
    fps
        Frames per second.
    pitch
        Pixel pitch, m/px.
    noise
        Standard deviation of the position per frame, m.
    law
        The assumed friction law.
    values
        Its parameters as the fit uses them (`stribeck`: rise over the Coulomb level).
    scatter
        Relative standard deviation of dry friction from run to run.
    course
        Length of the course in view, m.
    start
        Position where the course begins, m.
    completed
        Runs that were filmed already.
    assumed
        Assumptions as sentences.
    costs
        Costs of the runs, and what the set-up can do.

    """

    mass: float
    fps: float
    pitch: float
    noise: float
    law: Model
    values: dict[str, dict[str, float]]
    scatter: float = DEFAULT_SCATTER
    course: float = PICTURE_WIDTH_PX * 5e-4
    start: float = 0.0
    completed: tuple[RunDesign, ...] = ()
    assumed: tuple[str, ...] = ()
    costs: Costs = DEFAULT_COSTS

    @property
    def conditions(self) -> RunConditions:
        """Conditions common to all planned runs."""
        friction = self.values.get("coulomb", {}).get("F_c", self.mass * COULOMB_DECELERATION)
        zeros = np.zeros(1)
        path = Path(t=zeros, x=zeros, v=zeros, s=zeros + 1, mass=self.mass, pixel_pitch=self.pitch, gravity=GRAVITY)
        return RunConditions(self.fps, self.noise, self.mass, max(friction / self.mass, 0.1), path)


@checked
def default_setup(
    mass: Annotated[float, "kg"], fps: Annotated[float, "Hz"], pitch: Annotated[float, "m"]
) -> ExperimentSetup:
    """Make a setup of which only mass and camera are known; the friction law is typical.

    Parameters
    ----------
    mass
        Mass, kg.
    fps
        Frames per second.
    pitch
        Pixel pitch, m/px.

    Returns
    -------
    ExperimentSetup

    Examples
    --------
    >>> default_setup(0.35, 4000, 5e-4).values["coulomb"]
    {'F_c': 1.75}

    """
    level, noise = mass * COULOMB_DECELERATION, DEFAULT_NOISE_PX * pitch
    values = {
        "coulomb": {"F_c": level},
        "stribeck": {"F_s": STATIC_RISE_RATIO * level, "v_s": STRIBECK_VELOCITY, "delta": 1.0},
        "viscous": {"F_v": VISCOUS_RATIO * level},
    }
    course = PICTURE_WIDTH_PX * pitch
    assumed = (
        f"friction law: Coulomb friction decelerates the mass by {COULOMB_DECELERATION:g} m/s² ({level:.3g} N); static "
        f"friction is {100 * STATIC_RISE_RATIO:g} % higher (Stribeck velocity {STRIBECK_VELOCITY:g} m/s); viscous "
        f"friction adds {100 * VISCOUS_RATIO:g} % per m/s",
        f"position noise per frame: {DEFAULT_NOISE_PX:g} px ({format_plain(1e6 * noise, 3)} µm), white",
        f"course length: {course:.2g} m, a picture {PICTURE_WIDTH_PX} px wide",
        f"scatter of dry friction from run to run: {100 * DEFAULT_SCATTER:g} %",
    )
    law = models.of(list(values))
    return ExperimentSetup(mass, fps, pitch, noise, law, values, course=course, assumed=assumed)


def candidate_runs(setup: ExperimentSetup) -> list[RunDesign]:
    """List runs that could be filmed: speeds in both directions, other masses, a stop, a tilt, twice the frame rate.

    Parameters
    ----------
    setup
        The experimental setup.

    Returns
    -------
    list of RunDesign

    Examples
    --------
    >>> [run.key for run in candidate_runs(default_setup(0.35, 4000, 5e-4))][:3]
    ['1 m/s', '2 m/s', '4 m/s']

    """
    frames = np.inf if setup.costs.frames is None else setup.costs.frames
    conditions, course = setup.conditions, (setup.start, setup.start + setup.course)
    stop = _speed_to_stop(conditions.deceleration, PLANNED_STOP_SHARE * setup.course)
    runs = [(v, f"{v:g} m/s", f"one run at {v:g} m/s") for v in SPEEDS_M_S]
    runs += [(-v, f"{-v:g} m/s", f"one run at {v:g} m/s the other way") for v in RETURN_SPEEDS_M_S]
    runs += [(stop, "to a stop", f"one run at {stop:.1f} m/s until the mass stops by itself")]
    entries = [_plain_run(course, v, frames).changed(key, words) for v, key, words in runs]
    sentence = f"one run at {MIDDLE_SPEED_M_S:g} m/s {{}}"
    entries += _changed_runs(_plain_run(course, MIDDLE_SPEED_M_S, frames), sentence, sentence)
    return [e for e in entries if np.isfinite(setup.costs.of_run(conditions.settings(e), None))]


def fitted_setup(fit: Fit, costs: Costs = DEFAULT_COSTS) -> ExperimentSetup:
    """Derive the setup from a fit; its runs count as completed.

    Parameters
    ----------
    fit
        A fit of coasting runs to their displacement.
    costs
        Costs of the runs, and what the set-up can do.

    Returns
    -------
    ExperimentSetup

    Raises
    ------
    FrictrackError
        If friction or the drive was measured, or the model lacks Coulomb friction.

    """
    if fit.measured:
        raise FrictrackError(
            "expected runs whose displacement is filmed but their friction was measured; plan from a study without runs"
        )
    if any(run.drive is not None for run in fit.runs):
        raise FrictrackError(
            "expected runs that coast but their drive is measured; a plan is made for struck, pushed or tilted runs: "
            "plan from a study without runs"
        )
    solution, first = fit.solution, fit.runs[0]
    layout = solution.problem.layout
    base_effects = [e for e in fit.model.effects if e.in_base_law]
    if not any(e.name == "coulomb" for e in base_effects):
        raise FrictrackError("expected Coulomb friction in the fitted law to plan with; fit a model that has it")
    values, _ = layout.values(solution.p, 0)
    pitch = first.pixel_pitch
    noise = float(np.median(np.concatenate([p.sigma for p in solution.problem.pieces])))
    span, law, frames = layout.span, models.of(base_effects), max_frames_of_film(solution, costs)
    if len(layout.levels) < MIN_RUNS_FOR_SCATTER:
        scatter = stated = DEFAULT_SCATTER
        origin = "assumed because there are too few runs to estimate it"
    else:
        scatter, stated, origin = solution.tau_of_other_runs, solution.tau, "as fitted"
    assumed: tuple[str, ...] = (
        f"friction law fitted to {len(fit.runs)} runs: {law.equation(fit.parameters)}",
        f"position noise per frame: {format_plain(1e6 * noise, 3)} µm, as measured",
        f"course length: {span.x_max - span.x_min:.2g} m, as far as these runs went",
        f"scatter of dry friction from run to run: {100 * stated:.2g} %, {origin}",
    )
    if costs.frames is None and np.isfinite(frames):
        assumed += (
            f"largest number of frames in one film: {frames:.0f}, as in the longest film so far, which ended while the "
            "mass still moved; give frames in [costs] if the camera can film more",
        )
    setup = ExperimentSetup(
        mass=fit.reference.mass,
        fps=span.fps,
        pitch=pitch if pitch is not None else noise / DEFAULT_NOISE_PX,
        noise=noise,
        law=law,
        values={e.name: dict(values[e.name]) for e in base_effects},
        scatter=scatter,
        course=span.x_max - span.x_min,
        start=span.x_min,
        assumed=assumed,
        costs=replace(costs, frames=frames),
    )
    return replace(setup, completed=tuple(_completed_run(fit, setup, i) for i in range(len(fit.runs))))


def _completed_run(fit: Fit, setup: ExperimentSetup, index: int) -> RunDesign:
    """A run that was filmed."""
    run, problem = fit.runs[index], fit.solution.problem
    own = [(p, s) for p, s in zip(problem.pieces, fit.solution.starts, strict=True) if p.run == index]
    x, v = own[0][1]
    course = setup.start, setup.start + setup.course
    return RunDesign(
        (float(np.clip(x, *course)), float(v)),
        course,
        mass=(run.mass or setup.mass) / setup.mass,
        tilt=run.incline,
        frames=sum(len(p.t) for p, _ in own),
        key=f"run {run.name}",
        words=f"{run.name}, at {v:.2g} m/s",
    )
