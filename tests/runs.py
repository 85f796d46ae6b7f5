"""Simulated runs of known truth, and the library's laws written out a second time.

`force` and `picture` know nothing of frictrack's effects, and `integrate` knows nothing of its integrator: they
are what the code under test is held against. `runs` makes measured runs with frictrack's own simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy import cos, exp, pi, sin
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from frictrack.effects import models
from frictrack.effects.models import Model
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import GRAVITY as G
from frictrack.records import Displacement, Run
from frictrack.simulate import Conditions, simulate

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
# The same for effects that need more than place, velocity and time: the way so far, or what was measured beside x.
TOLD = {
    "decaying_vibration": {"amplitude": 1.5, "frequency": 61.3, "tau": 0.03, "phase": 0.7},
    "beam_vibration": {"amplitude": 1.0, "frequency": 45.3, "r": 0.8, "beam_length": 0.9, "phase": 0.4},
    "viscous_modulation": {"depth": 0.3, "frequency": 47.0, "phase": -0.4},
    "measured_load": {"coefficient": 1.0},
    "gravity": {"g": G},
    "thermal": {"dF": 2.0, "length": 0.08},
    "drift": {"k": 20.0},
    "drive_error": {"e": 0.2, "tau": 0.003},
    "drive_delay": {"tau": 0.003, "share": 1.0},
    "drive_offset": {"D_0": 1.2},
    "dropped_frame": {"frames": 1.0, "time": 0.0400 + 0.5 / FPS},
    "timebase": {"k": 0.02},
    "target_rotation": {"along": 0.03, "across": 0.02},
    "flash_weakening": {"dF": 4.0, "v_w": 3.0},
    "log_velocity": {"a": -0.2, "v_0": 1e-6},
    "power_law_viscosity": {"c": 1.0, "n": 0.6},
    "eddy_brake": {"c": 1.5, "v_0": 2.0},
    "hydrodynamic_hump": {"F": 4.0, "v_s": 2.0},
    "adhesion": {"F": 2.0},
    "load_exponent": {"excess": -0.3},
    "run_in": {"dF": 1.5, "length": 0.7},
    "heating": {"k": 3.0, "tau": 40.0},
    "rolling_shutter": {"tau": 2e-4},
    "out_of_plane": {"k": 0.02},
}
TIMED = ("clock_rate",)  # held against scaled times elsewhere
REMEMBERED = (  # held against integrators of their own elsewhere
    *("presliding", "friction_lag", "cell_lag", "cell_delay", "cell_drift", "lugre", "bouc_wen", "elasto_plastic"),
    *("rate_state_ageing", "rate_state_slip", "maxwell_slip", "elastic_joint"),
)


def drive(t):
    """A push that grows from nothing and swings, N."""
    return 6.0 * (1 - cos(2 * pi * 25.0 * np.maximum(t, 0.0)))


def lift(t):
    """Vertical acceleration of a mass on a shaking course, m/s^2."""
    return 4.0 * sin(2 * pi * 33.0 * t + 0.5)


def angle(t):
    """By how much a rocking target has turned, rad."""
    return 0.08 * sin(2 * pi * 35.0 * t + 0.3)


EARLIER = ((95.0, 0.4), (12.0, 0.55))  # s since its end, m slid in it, of the two runs before
# What the runs of an effect must tell.
KNOWN = {
    "beam_vibration": {"clamp_x": -0.1, "beam_length": 0.9},
    "measured_load": {"lift": lift},
    "drive_error": {"drive": drive},
    "drive_delay": {"drive": drive},
    "drive_offset": {"drive": drive},
    "target_rotation": {"angle": angle},
    "gravity": {"curvature": 1.5, "lowest": 0.2},
    "run_in": {"earlier": EARLIER},
    "heating": {"earlier": EARLIER},
}


@dataclass(frozen=True)
class Slider:
    """What holds in one run besides the law: push (N) is the drive less gravity along the course.

    `slid` (m) and `turns` (cycles of the beam) are the way so far.
    """

    mass: float = MASS
    load: float = 1.0
    mass_ratio: float = 1.0
    pitch: float = PITCH
    push: Callable[[float], float] = lambda t: 0.0
    clamp_x: float = KNOWN["beam_vibration"]["clamp_x"]
    slid: float = 0.0
    turns: float = 0.0


def sine(q, frequency, t, phase="phase"):
    return sin(2 * pi * q[frequency] * t + q[phase])


def _atm2_1(q, x, v, t, s, slider):
    level = sine(q, "sliding_frequency_1", t, "sliding_phase_1") * q["f_c"]
    dry = level + (q["f_s"] - level) * exp(-abs(v) / q["v_s"])
    return slider.load * s * dry + sine(q, "viscous_frequency_1", t, "viscous_phase_1") * q["f_v"] * v


# The table of the design by hand: N that each effect adds, at place x, velocity v, time t, direction s.
LAWS = {
    "coulomb": lambda q, x, v, t, s, slider: slider.load * s * q["F_c"] + 0 * v,
    "stribeck": lambda q, x, v, t, s, slider: slider.load * s * q["F_s"] * exp(-((abs(v) / q["v_s"]) ** q["delta"])),
    "viscous": lambda q, x, v, t, s, slider: q["F_v"] * v,
    "drag": lambda q, x, v, t, s, slider: q["c"] * v * abs(v),
    "vibration": lambda q, x, v, t, s, slider: q["amplitude"] * sine(q, "frequency", t),
    "texture": lambda q, x, v, t, s, slider: (
        slider.load * s * q["amplitude"] * sin(2 * pi * x / q["period"] + q["phase"])
    ),
    "patch": lambda q, x, v, t, s, slider: slider.load * s * q["F"] * exp(-((x - q["x_c"]) ** 2) / (2 * q["w"] ** 2)),
    "collision": lambda q, x, v, t, s, slider: (
        q["J"] / q["width"] / np.sqrt(2 * pi) * exp(-((t - q["time"]) ** 2) / (2 * q["width"] ** 2))
    ),
    "spring": lambda q, x, v, t, s, slider: q["k"] * x + q["x_0"],  # the linear coefficient x_0 is k x_0, N
    "asymmetry": lambda q, x, v, t, s, slider: q["dF"] * slider.load + q["dF_v"] * abs(v),
    "gravity": lambda q, x, v, t, s, slider: q["g"] * slider.mass * sin(1.5 * (x - 0.2)),
    "slope": lambda q, x, v, t, s, slider: q["F"] * slider.mass_ratio + 0 * v,
    "decaying_vibration": lambda q, x, v, t, s, slider: q["amplitude"] * exp(-t / q["tau"]) * sine(q, "frequency", t),
    "beam_vibration": lambda q, x, v, t, s, slider: q["amplitude"] * sin(2 * pi * slider.turns + q["phase"]),
    "thermal": lambda q, x, v, t, s, slider: -slider.load * s * q["dF"] * (1 - exp(-slider.slid / q["length"])),
    "drift": lambda q, x, v, t, s, slider: slider.load * s * q["k"] * t,
    "drive_error": lambda q, x, v, t, s, slider: -q["e"] * drive(t - q["tau"]),
    "drive_offset": lambda q, x, v, t, s, slider: -q["D_0"] + 0 * v,
    "drive_delay": lambda q, x, v, t, s, slider: drive(t) - drive(t - q["tau"]),
    "flash_weakening": lambda q, x, v, t, s, slider: -slider.load * s * q["dF"] * abs(v) / (q["v_w"] + abs(v)),
    "log_velocity": lambda q, x, v, t, s, slider: slider.load * s * q["a"] * np.log(1 + abs(v) / q["v_0"]),
    "power_law_viscosity": lambda q, x, v, t, s, slider: s * q["c"] * abs(v) ** q["n"],
    "eddy_brake": lambda q, x, v, t, s, slider: q["c"] * v * q["v_0"] ** 2 / (q["v_0"] ** 2 + v**2),
    "hydrodynamic_hump": lambda q, x, v, t, s, slider: (
        slider.load * s * q["F"] * abs(v) / q["v_s"] * exp(-abs(v) / q["v_s"])
    ),
    "adhesion": lambda q, x, v, t, s, slider: s * q["F"] + 0 * v,
    "run_in": lambda q, x, v, t, s, slider: (
        slider.load * s * q["dF"] * (exp(-(0.4 + 0.55 + slider.slid) / q["length"]) - 1)
    ),
    "heating": lambda q, x, v, t, s, slider: (
        -slider.load * s * q["k"] * (slider.slid + 0.4 * exp(-95.0 / q["tau"]) + 0.55 * exp(-12.0 / q["tau"]))
    ),
    "atm2:1": _atm2_1,
}
# What multiplies the effects that a modifier reshapes, all of them dry friction but in one case.
FACTORS = {
    "load_modulation": lambda q, t, slider: 1 + q["depth"] * sine(q, "frequency", t),
    "measured_load": lambda q, t, slider: np.maximum(G + q["coefficient"] * lift(t), 0) / G,
    "viscous_modulation": lambda q, t, slider: 1 + q["depth"] * sine(q, "frequency", t),
    "load_exponent": lambda q, t, slider: slider.mass_ratio ** q["excess"],
}
# Metres that each effect shifts the picture.
SHIFTS = {
    "lens": lambda q, x, t, slider: q["k"] * (x - q["x_c"]) ** 3,
    "peak_locking": lambda q, x, t, slider: q["amplitude"] * slider.pitch * sin(2 * pi * x / slider.pitch + q["phase"]),
    "camera_shake": lambda q, x, t, slider: q["amplitude"] * cos(2 * pi * q["frequency"] * t + q["phase"] - pi / 2),
    "out_of_plane": lambda q, x, t, slider: q["k"] * x * x,
}
# The same of a mass that moves at v.
MOVED = {
    "dropped_frame": lambda q, x, v, t: np.where(t > q["time"], q["frames"] * v / FPS, 0.0),
    "timebase": lambda q, x, v, t: v * q["k"] * t**2 / 2,
    "rolling_shutter": lambda q, x, v, t: q["tau"] * x * v,
    "target_rotation": lambda q, x, v, t: (complex(q["along"], q["across"]) * (exp(1j * angle(t)) - 1)).real,
}
DRY = ("coulomb", "stribeck")  # what a modulation of the load reshapes


def reshaped(values, name, t, slider):
    """What modifiers make of the force of one effect, as a factor."""
    modifiers = {"viscous_modulation"} if name == "viscous" else FACTORS.keys() - {"viscous_modulation"}
    touched = modifiers & values.keys() if name in (*DRY, "viscous") else ()
    return np.prod([FACTORS[m](values[m], t, slider) for m in touched], axis=0)


def force(values, x, v, t, s, slider=Slider()):
    """Friction force in N."""
    own = {name: q for name, q in values.items() if name in LAWS}
    if "gravity" in values:
        slider = replace(slider, load=slider.load * abs(cos(1.5 * (x - 0.2)) + 1.5 * v * v / G))
    return sum(LAWS[name](q, x, v, t, s, slider) * reshaped(values, name, t, slider) for name, q in own.items())


def picture(values, x, t, slider=Slider(), v=None):
    """Measurement shift in m of a mass at x at time t."""
    still = sum(SHIFTS[name](q, x, t, slider) for name, q in values.items() if name in SHIFTS)
    return still + sum(MOVED[name](q, x, v, t) for name, q in values.items() if name in MOVED)


def tone(values, x, slider):
    """Frequency of the beam with the mass at x, Hz."""
    q = values.get("beam_vibration")
    if q is None:
        return 0.0
    away, l = x - slider.clamp_x, q["beam_length"]  # noqa: E741 - as in the formula
    shape = (3 * l * away**2 - away**3) / (2 * l**3)
    return q["frequency"] / np.sqrt(1 + slider.mass_ratio * q["r"] * shape**2)


def integrate(values, slider, t, start, *, max_step=np.inf):
    """Displacement (n,) by scipy's order-8 Runge-Kutta, from event to event: sliding, stop, sticking, release."""
    x = np.full(len(t), np.nan)
    now, place, speed = t[0], *start
    way = [0.0, 0.0]  # slid, turns
    while now < t[-1]:
        s = np.sign(speed) or _sets_off(values, slider, now, place)
        if s == 0:
            release = _release(values, slider, now, place, t[-1])
            x[(t >= now) & (t <= release)] = place
            now = release + 1e-9
            continue
        inside = (t >= now - 1e-12) & np.isnan(x)
        solved = solve_ivp(
            lambda tau, z, s=s: _moves(values, slider, tau, z, s),
            (now, t[-1]),
            [place, speed, *way],
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
        now, place, speed, way = end, solved.y[0, -1], 0.0, solved.y[2:, -1]
    return x


def _moves(values, slider, t, z, s):
    here = replace(slider, slid=z[2], turns=z[3]) if TOLD.keys() & values.keys() else slider
    return [
        z[1],
        (slider.push(t) - force(values, z[0], z[1], t, s, here)) / slider.mass,
        abs(z[1]),
        tone(values, z[0], slider),
    ]


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
    for a, b in pairwise(steps):
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
FOUR = (SIX[0], SIX[1], SIX[3], SIX[5])  # the same, as few as let the levels scatter
PER_RUN_PHASE = (
    *("vibration", "load_modulation", "camera_shake"),
    *("decaying_vibration", "beam_vibration", "viscous_modulation"),
)


def measured(t, x, *, sigma, mass=MASS, name="run", pitch=PITCH, rng=None, valid=None, **known):
    """A run whose displacement x (n,) was seen with white noise of sigma m."""
    rng = rng or np.random.default_rng(0)
    nan = np.full(len(t), np.nan)
    valid = np.ones(len(t), bool) if valid is None else valid
    y = np.where(valid, x + sigma * rng.standard_normal(len(t)), np.nan)
    seen = Displacement(t, y, nan, nan, np.full(len(t), sigma), nan, valid, pixel_pitch=pitch)
    return Run(seen, plain_motion(seen), mass=mass, name=name, **known)


def plain_motion(seen):
    """The motion of a displacement smoothed by a trend of one stiffness, with the deviations of that smoother itself.

    Deviations that hold for any motion take a second search, for the best smoother, which costs most of making a run.
    """
    return differentiate(replace(low_pass(seen, method="kalman"), asked=False))


def study(model: Model | str = "tustin", values=BASE, specs=SIX, *, sigma=1e-8, scatter=0.0, rng=None, gap=None):
    """Runs of one law, and the levels that their dry friction got; phases that belong to a run are redrawn."""
    rng = rng or np.random.default_rng(0)
    law = models.parse(model) if isinstance(model, str) else model
    known = {key: value for name in values for key, value in KNOWN.get(name, {}).items()}
    made, levels = [], 1 + scatter * rng.standard_normal(len(specs))
    for i, (spec, level) in enumerate(zip(specs, levels, strict=True)):
        t = np.arange(round(spec.duration * FPS)) / FPS
        if "earlier" in known:  # every run has a past of its own
            known |= {"earlier": tuple((rest * 0.7**i, slid * i) for rest, slid in EARLIER)}
        own = {k: dict(q) for k, q in values.items()}
        for name in PER_RUN_PHASE:
            if name in own:
                own[name]["phase"] = rng.uniform(-pi, pi)
        held = Conditions(MASS * spec.ratio, spec.ratio * level, spec.ratio, PITCH, **known)
        slide = simulate(law, own, held, t, (0.0 if spec.speed > 0 else 0.6, spec.speed))
        valid = np.ones(len(t), bool)
        if gap:
            valid[gap] = False
        run = measured(t, slide.x + slide.shift, sigma=sigma, mass=held.mass, name=f"r{i}", rng=rng, valid=valid)
        made.append(telling(run, known))
    return made, levels


def telling(run, known):
    """The run with what else was measured exactly."""
    t = run.motion.t
    told = {key: value for key, value in known.items() if key in ("clamp_x", "beam_length", "earlier")}
    if "lowest" in known:
        told |= {
            "radius": 1 / known["curvature"],
            "incline": -known["lowest"] * known["curvature"],
            "has_incline": True,
        }
    if "drive" in known:
        told["drive"] = known["drive"](t)
    if "lift" in known:
        told["motion"] = replace(run.motion, a_y=known["lift"](t))
    if "angle" in known:
        told["displacement"] = replace(run.displacement, angle=known["angle"](t))
    return replace(run, **told)


def with_hidden(name):
    """Tustin with one more effect of the library, and its values in `HIDDEN` or `TOLD`."""
    return models.tustin() + name, BASE | {name: (HIDDEN | TOLD)[name]}
