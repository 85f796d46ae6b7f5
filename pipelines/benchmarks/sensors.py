"""Align synthetic accelerometers of known delay, gain and bias, and count the alignments that are wrong unsaid.

    python pipelines/benchmarks/sensors.py --sensors 334

A mass slides under Coulomb and viscous friction and vibrates at one frequency, all in closed form. The film has 4 kHz,
the sensor 10 to 25 kHz. A sensor keeps its delay, gain and bias over two to four runs. An alignment is wrong where its
offset is off by more than five of its standard deviations; unsaid, where its `reason` does not call it ambiguous.
"resolved": all runs of a sensor together leave one delay, which is advised; it is wrong where it is off by more than
0.1 ms and five of its deviations.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from frictrack.measure.plausibility import implausible_sensors
from frictrack.measure.sensors import AlignmentProblem, SensorRecord, align, compare_with_camera, second_differences
from frictrack.records import Array, Displacement

Acceleration = Callable[[Array], Array]
FPS = 4000.0  # of the film, 1/s
RUNS = (2, 5)  # of one sensor, the upper end excluded
MAX_SIGMAS = 5.0  # standard deviations from which an offset is wrong
MAX_ADVICE_ERROR = 1e-4  # s
AMBIGUOUS = ("ambiguous", "several that agree equally well")  # words of `reason`, now and before December 2026


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def slide(rng: np.random.Generator, amplitude: float, frequency: float) -> tuple[Array, Array, Acceleration]:
    """Frames (s), positions at the frames (m) and acceleration over time (m/s^2), in closed form.

    Friction is Coulomb and viscous. One vibration lasts over the film and decays; in half of the slides an impact
    starts it once more.
    """
    v0, coulomb, rate = rng.uniform(1.0, 4.0), rng.uniform(2.0, 8.0), rng.uniform(0.1, 3.0)  # m/s, m/s^2, 1/s
    t = np.arange(int(FPS * rng.uniform(0.08, 0.25))) / FPS
    s = 2j * np.pi * frequency - 1.0 / log_uniform(rng, 0.02, 2.0)  # 1/s: frequency and decay of the vibration
    steady = amplitude * np.exp(1j * rng.uniform(0.0, 2.0 * np.pi))
    struck, blow = t[-1] * rng.uniform(0.1, 0.9), amplitude * rng.integers(2) * rng.uniform(0.5, 2.0)

    def a(at: Array) -> Array:
        u = np.maximum(at - struck, 0.0)
        friction = -(rate * v0 + coulomb) * np.exp(-rate * at)
        return friction + np.imag(steady * np.exp(s * at) + blow * np.exp(s * u))

    u = np.maximum(t - struck, 0.0)
    x = (v0 + coulomb / rate) / rate * (1.0 - np.exp(-rate * t)) - coulomb / rate * t
    x += np.imag(steady * np.exp(s * t) / s**2 + blow * (np.exp(s * u) - 1.0 - s * u) / s**2)
    return t, x, a


def sensor_problems(seed: int) -> tuple[float, float, list[AlignmentProblem]]:
    """Offset (s), gain and alignment problems of one sensor over its runs."""
    rng = np.random.default_rng(seed)
    delay, gain = rng.uniform(0.0, 5e-3), -1.0 if rng.random() < 0.2 else rng.uniform(0.8, 1.2)
    bias, noise, rate = rng.normal(0.0, 1.0), log_uniform(rng, 0.05, 2.0), rng.uniform(1e4, 2.5e4)
    frequency, sigma = log_uniform(rng, 20.0, 800.0), log_uniform(rng, 1e-6, 2e-5)
    problems = []
    for _ in range(int(rng.integers(*RUNS))):
        t, x, a = slide(rng, log_uniform(rng, 1.0, 40.0), frequency * rng.uniform(0.97, 1.03))
        nan = np.full(len(t), np.nan)
        seen = x + sigma * rng.standard_normal(len(t))
        film = Displacement(t, seen, nan, nan, np.full(len(t), sigma), nan, np.ones(len(t), bool))
        clock = np.arange(-0.03, t[-1] + 0.04, 1.0 / rate)
        values = (a(clock - delay) - bias) / gain + noise * rng.standard_normal(len(clock))
        series, frames = SensorRecord(clock, values, "acc.csv"), second_differences(film)
        problems.append(AlignmentProblem(frames, series, np.ones((len(frames.z), 1)), series.sigma))
    return -delay, gain, problems


def main() -> None:
    """Align all and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=334, help="sensors; three runs each on average")
    parser.add_argument("--first", type=int, default=0, help="seed of the first sensor")
    args = parser.parse_args()
    counts, start = Counter[str](), time.perf_counter()
    for seed in range(args.first, args.first + args.sensors):
        offset, gain, problems = sensor_problems(seed)
        clocks: dict[str, dict[str, Any]] = {}
        for k, problem in enumerate(problems):
            found = align(problem)
            same = {name: getattr(found, name) for name in ("gain", "sigma_gain", "rivals")}
            clocks[str(k)] = {"offset_s": found.offset, "sigma_offset_s": found.sigma_offset, **same}
            used = compare_with_camera(problem, found).verdict == "consistent"
            said = any(words in found.reason for words in AMBIGUOUS)
            counts["alignments"] += 1
            if found.sigma_offset is None:
                counts["called ambiguous" if said else "not determined"] += 1
                continue
            sigmas = (found.offset - offset) / found.sigma_offset
            wrong = abs(sigmas) > MAX_SIGMAS
            counts["called ambiguous"] += said
            counts["used"] += used
            counts["wrong"] += wrong
            counts["wrong and unsaid"] += wrong and not said
            counts["wrong and used"] += wrong and used
            counts["sign wrong and unsaid"] += (found.gain or 0.0) * gain < 0 and not said
            counts["beyond 3 deviations and unsaid"] += abs(sigmas) > 3.0 and not said
            if wrong and not said:
                print(f"{seed}.{k}: {1e3 * found.offset:.4g} ms ({sigmas:.3g} sigma), gain {found.gain:.3g}/{gain:.3g}")
        for advice in implausible_sensors(clocks):
            if advice.correction:
                told = 1e-3 * float(advice.correction.split('"')[1].removesuffix(" ms"))
                error, sigmas = abs(told - offset), [c["sigma_offset_s"] for c in clocks.values() if not c["rivals"]]
                counts["resolved"] += 1
                counts["resolved wrongly"] += error > max(
                    MAX_ADVICE_ERROR, MAX_SIGMAS * min(filter(None, sigmas), default=0.0)
                )
    print({**counts, "seconds": round(time.perf_counter() - start)})


if __name__ == "__main__":
    main()
