"""Simulated runs of known truth, and the library's laws written out a second time.

`force` and `picture` know nothing of frictrack's effects, and `integrate` knows nothing of its integrator: they
are what the code under test is held against. `runs` makes measured runs with frictrack's own simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import cos, exp, pi, sin
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from frictrack import models
from frictrack.models import Model
from frictrack.motion import differentiate, low_pass
from frictrack.records import Displacement, Run
from frictrack.simulate.slide import Conditions, simulate

FPS = 4000.0
MASS = 0.35
PITCH = 5e-4
BASE = {"coulomb": {"F_c": 8.0}, "stribeck": {"F_s": 6.0, "v_s": 0.4, "delta": 1.0}, "viscous": {"F_v": 1.2}}
# One setting per effect, of a size that films of such runs show. The Stribeck F_s here is the rise over F_c.
HIDDEN = {
    "drag": {"c": 0.05},
    "vibration": {"amplitude": 0.8, "frequency": 61.3, "phase": 0.7},
    "texture": {"amplitude": 0.8, "period": 0.03, "phase": 1.0},
    "patch": {"F": 2.0, "x_c": 0.21, "w": 0.02},
    "spring": {"k": 3.0, "x_0": 0.5},
    "collision": {"J": 0.05, "time": 0.06, "width": 4e-4},
    "asymmetry": {"dF": 1.5, "dF_v": 0.1},
    "slope": {"F": 1.2},
    "load_modulation": {"depth": 0.1, "frequency": 47.0, "phase": -0.4},
    "lens": {"k": 1e-3, "x_c": 0.3},
    "peak_locking": {"amplitude": 0.05, "phase": 0.5},
    "camera_shake": {"amplitude": 4e-5, "frequency": 83.0, "phase": 0.9},
}
PICTURE = ("lens", "peak_locking", "camera_shake")


@dataclass(frozen=True)
class Slider:
    """What holds in one run besides the law: push (N) is the drive less gravity along the course."""

    mass: float = MASS
    load: float = 1.0
    mass_ratio: float = 1.0
    pitch: float = PITCH
    push: Callable[[float], float] = lambda t: 0.0


def force(values, x, v, t, s, slider=Slider()):
    """Friction force in N at place x, velocity v, time t, direction s: the table of the design, by hand."""
    speed = abs(v)
    q, total, dry = values, 0.0, 0.0
    if "coulomb" in q:
        dry = dry + q["coulomb"]["F_c"]
    if "stribeck" in q:
        dry = dry + q["stribeck"]["F_s"] * exp(-((speed / q["stribeck"]["v_s"]) ** q["stribeck"]["delta"]))
    if "load_modulation" in q:
        m = q["load_modulation"]
        dry = dry * (1 + m["depth"] * sin(2 * pi * m["frequency"] * t + m["phase"]))
    if "texture" in q:
        m = q["texture"]
        dry = dry + m["amplitude"] * sin(2 * pi * x / m["period"] + m["phase"])
    if "patch" in q:
        dry = dry + q["patch"]["F"] * exp(-((x - q["patch"]["x_c"]) ** 2) / (2 * q["patch"]["w"] ** 2))
    total = total + slider.load * s * dry
    if "viscous" in q:
        total = total + q["viscous"]["F_v"] * v
    if "drag" in q:
        total = total + q["drag"]["c"] * v * speed
    if "vibration" in q:
        m = q["vibration"]
        total = total + m["amplitude"] * sin(2 * pi * m["frequency"] * t + m["phase"])
    if "collision" in q:
        m = q["collision"]
        z = (t - m["time"]) / m["width"]
        total = total + m["J"] * exp(-z * z / 2) / (m["width"] * np.sqrt(2 * pi))
    if "spring" in q:
        total = total + q["spring"]["k"] * x + q["spring"]["x_0"]
    if "asymmetry" in q:
        total = total + q["asymmetry"]["dF"] * slider.load + q["asymmetry"]["dF_v"] * speed
    if "slope" in q:
        total = total + q["slope"]["F"] * slider.mass_ratio
    if "atm2:1" in q:
        m = q["atm2:1"]
        s_c = sin(2 * pi * m["sliding_frequency_1"] * t + m["sliding_phase_1"])
        s_v = sin(2 * pi * m["viscous_frequency_1"] * t + m["viscous_phase_1"])
        hook = exp(-speed / m["v_s"])
        total = total + slider.load * s * (s_c * m["f_c"] + (m["f_s"] - s_c * m["f_c"]) * hook) + s_v * m["f_v"] * v
    return total


def picture(values, x, t, slider=Slider()):
    """Measurement shift in m of a mass at x at time t."""
    total = 0.0 * x
    if "lens" in values:
        total = total + values["lens"]["k"] * (x - values["lens"]["x_c"]) ** 3
    if "peak_locking" in values:
        m = values["peak_locking"]
        total = total + m["amplitude"] * slider.pitch * sin(2 * pi * x / slider.pitch + m["phase"])
    if "camera_shake" in values:
        m = values["camera_shake"]
        total = total + m["amplitude"] * cos(2 * pi * m["frequency"] * t + m["phase"] - pi / 2)
    return total


def integrate(values, slider, t, start, *, max_step=np.inf):
    """Displacement (n,) by scipy's order-8 Runge-Kutta, from event to event: sliding, stop, sticking, release."""
    x = np.full(len(t), np.nan)
    now, place, speed = t[0], *start
    while now < t[-1]:
        s = np.sign(speed) or _sets_off(values, slider, now, place)
        if s == 0:
            release = _release(values, slider, now, place, t[-1])
            x[(t >= now) & (t <= release)] = place
            now = release + 1e-9
            continue
        inside = (t >= now - 1e-12) & np.isnan(x)
        ends = t[-1]
        solved = solve_ivp(
            lambda tau, z, s=s: [z[1], (slider.push(tau) - force(values, z[0], z[1], tau, s, slider)) / slider.mass],
            (now, ends),
            [place, speed],
            method="DOP853",
            dense_output=True,
            events=_stops(s),
            rtol=1e-12,
            atol=1e-14,
            max_step=max_step,
        )
        end = solved.t[-1]
        here = inside & (t <= end)
        x[here] = solved.sol(np.maximum(t[here], now))[0]
        now, place, speed = end, solved.y[0, -1], 0.0
    return x


def _stops(s):
    def event(tau, z):
        return z[1] + s * 1e-15

    event.terminal, event.direction = True, -s
    return event


def _gap(values, slider, t, x, s):
    return s * (slider.push(t) - force(values, x, 0.0, t, s, slider))


def _sets_off(values, slider, t, x):
    return next((s for s in (1.0, -1.0) if _gap(values, slider, t, x, s) > 1e-9), 0.0)


def _release(values, slider, now, x, end):
    steps = np.arange(now, end, 1e-4)
    for a, b in zip(steps[:-1], steps[1:], strict=True):
        for s in (1.0, -1.0):
            if _gap(values, slider, b, x, s) > 1e-9:
                return brentq(lambda tau, s=s: _gap(values, slider, tau, x, s) - 1e-9, a, b, xtol=1e-15)
    return end


@dataclass(frozen=True)
class Spec:
    """One run to be made: start speed m/s (negative is reversed), mass over the reference, duration s."""

    speed: float
    ratio: float = 1.0
    duration: float = 0.12


# Three speeds, a double mass, two reversed. The slowest nearly stops.
SIX = (Spec(2.2, 1, 0.075), Spec(4.0), Spec(6.0), Spec(4.5, 2), Spec(-4.0), Spec(-5.5))
PER_RUN_PHASE = ("vibration", "load_modulation", "camera_shake")


def measured(t, x, *, sigma, mass=MASS, name="run", pitch=PITCH, rng=None, valid=None, **known):
    """A run whose displacement x (n,) was seen with white noise of sigma m."""
    rng = rng or np.random.default_rng(0)
    nan = np.full(len(t), np.nan)
    valid = np.ones(len(t), bool) if valid is None else valid
    y = np.where(valid, x + sigma * rng.standard_normal(len(t)), np.nan)
    seen = Displacement(t, y, nan, nan, np.full(len(t), sigma), nan, valid, pixel_pitch=pitch)
    return Run(seen, differentiate(low_pass(seen)), mass=mass, name=name, **known)


def study(model: Model | str = "tustin", values=BASE, specs=SIX, *, sigma=1e-8, scatter=0.0, rng=None, gap=None):
    """Runs of one law, and the levels that their dry friction got; phases that belong to a run are redrawn."""
    rng = rng or np.random.default_rng(0)
    law = models.parse(model) if isinstance(model, str) else model
    made, levels = [], 1 + scatter * rng.standard_normal(len(specs))
    for i, (spec, level) in enumerate(zip(specs, levels, strict=True)):
        t = np.arange(round(spec.duration * FPS)) / FPS
        own = {k: dict(q) for k, q in values.items()}
        for name in PER_RUN_PHASE:
            if name in own:
                own[name]["phase"] = rng.uniform(-pi, pi)
        held = Conditions(MASS * spec.ratio, spec.ratio * level, spec.ratio, PITCH)
        slide = simulate(law, own, held, t, (0.0 if spec.speed > 0 else 0.6, spec.speed))
        valid = np.ones(len(t), bool)
        if gap:
            valid[gap] = False
        made.append(measured(t, slide.x + slide.shift, sigma=sigma, mass=held.mass, name=f"r{i}", rng=rng, valid=valid))
    return made, levels


def with_hidden(name):
    """Tustin with one more effect of the library, and the values of `HIDDEN` for it."""
    return models.tustin() + name, BASE | {name: HIDDEN[name]}
