"""Describe the experimental setup before filming: known and assumed values, and the runs that could be filmed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from frictrack import models
from frictrack.costs import DEFAULT_COSTS, Costs
from frictrack.diagnose.experiments.menu import Experiment, changed_runs
from frictrack.diagnose.experiments.virtual_runs import DEFAULT_SCATTER, RunConditions, RunDesign, max_frames_of_film
from frictrack.effects import Path
from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.models import Model
from frictrack.number_format import format_plain
from frictrack.records import GRAVITY

PICTURE_WIDTH_PX = 800  # width of a picture, px
DEFAULT_NOISE_PX = 0.02  # position noise per frame, px
SPEEDS_M_S = (1.0, 2.0, 4.0, 6.0, 8.0)
RETURN_SPEEDS_M_S = (2.0, 4.0, 8.0)  # in the other direction
MIDDLE_SPEED_M_S = 4.0  # at which mass, tilt and frame rate are varied
STOP_WITHIN_SHARE = 0.85  # of the course
COULOMB_DECELERATION = 5.0  # m/s^2
STATIC_RISE_RATIO = 0.3  # static over Coulomb friction, minus one
STRIBECK_VELOCITY = 0.3  # m/s
VISCOUS_RATIO = 0.1  # viscous friction per m/s, over Coulomb friction


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
    completed: tuple[Experiment, ...] = ()
    assumed: tuple[str, ...] = ()
    costs: Costs = DEFAULT_COSTS

    @property
    def friction(self) -> float:
        """Dry friction at speed, N."""
        return self.values.get("coulomb", {}).get("F_c", self.mass * COULOMB_DECELERATION)

    @property
    def conditions(self) -> RunConditions:
        """Conditions common to all planned runs."""
        zeros = np.zeros(1)
        path = Path(t=zeros, x=zeros, v=zeros, s=zeros + 1, mass=self.mass, pixel_pitch=self.pitch, gravity=GRAVITY)
        return RunConditions(self.fps, self.noise, self.mass, max(self.friction / self.mass, 0.1), path)


def default_setup(mass: float, fps: float, pitch: float) -> ExperimentSetup:
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


def candidate_runs(setup: ExperimentSetup) -> list[Experiment]:
    """List runs that could be filmed: speeds in both directions, other masses, a stop, a tilt, twice the frame rate.

    Parameters
    ----------
    setup
        The experimental setup.

    Returns
    -------
    list of Experiment

    Examples
    --------
    >>> [run.key for run in candidate_runs(default_setup(0.35, 4000, 5e-4))][:3]
    ['1 m/s', '2 m/s', '4 m/s']

    """
    plain = plain_run(setup, MIDDLE_SPEED_M_S)
    entries = [*_speeds(setup), *changed_runs(plain, f"one run at {MIDDLE_SPEED_M_S:g} m/s")]
    conditions = setup.conditions
    return [e for e in entries if np.isfinite(setup.costs.of_run(conditions.settings(e.design), None))]


def plain_run(setup: ExperimentSetup, speed: float) -> RunDesign:
    """Design of a plain run at a speed, m/s; negative speeds go the other way."""
    far = setup.start + setup.course
    frames = np.inf if setup.costs.frames is None else setup.costs.frames
    return RunDesign((setup.start if speed > 0 else far, speed), (setup.start, far), frames=frames)


def _speeds(setup: ExperimentSetup) -> Iterator[Experiment]:
    for v in SPEEDS_M_S:
        yield Experiment(f"{v:g} m/s", f"one run at {v:g} m/s", plain_run(setup, v))
    for v in RETURN_SPEEDS_M_S:
        yield Experiment(f"{-v:g} m/s", f"one run at {v:g} m/s the other way", plain_run(setup, -v))
    stop = float(np.sqrt(2 * setup.conditions.deceleration * STOP_WITHIN_SHARE * setup.course))
    yield Experiment("to a stop", f"one run at {stop:.1f} m/s until the mass stops by itself", plain_run(setup, stop))


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
    scatter_is_assumed = len(layout.levels) < MIN_RUNS_FOR_SCATTER
    span = layout.span
    law = models.of(base_effects)
    scatter = 100 * (DEFAULT_SCATTER if scatter_is_assumed else solution.tau)
    assumed: tuple[str, ...] = (
        f"friction law fitted to {len(fit.runs)} runs: {law.equation(fit.parameters)}",
        f"position noise per frame: {format_plain(1e6 * noise, 3)} µm, as measured",
        f"course length: {span.x_max - span.x_min:.2g} m, as far as these runs went",
        f"scatter of dry friction from run to run: {scatter:.2g} %, "
        + ("assumed because there are too few runs to estimate it" if scatter_is_assumed else "as fitted"),
    )
    frames = max_frames_of_film(solution, costs)
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
        scatter=DEFAULT_SCATTER if scatter_is_assumed else solution.tau_of_other_runs,
        course=span.x_max - span.x_min,
        start=span.x_min,
        assumed=assumed,
        costs=replace(costs, frames=frames),
    )
    return replace(setup, completed=tuple(_completed_run(fit, setup, i) for i in range(len(fit.runs))))


def _completed_run(fit: Fit, setup: ExperimentSetup, index: int) -> Experiment:
    """A run that was filmed, as an experiment."""
    run = fit.runs[index]
    pieces = zip(fit.solution.problem.pieces, fit.solution.starts, strict=True)
    start = next(s for p, s in pieces if p.run == index)
    ends = setup.start, setup.start + setup.course
    place = float(np.clip(start[0], *ends))
    mass = (run.mass or setup.mass) / setup.mass
    frames = sum(len(p.t) for p in fit.solution.problem.pieces if p.run == index)
    design = RunDesign((place, float(start[1])), ends, mass=mass, tilt=run.incline, frames=frames)
    return Experiment(f"run {run.name}", f"{run.name}, at {start[1]:.2g} m/s", design)
