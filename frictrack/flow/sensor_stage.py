"""What other instruments and further targets of a film recorded, brought to the camera's clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from frictrack import measure, study
from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.flow.pipeline import RunPipeline
from frictrack.records import Array, Displacement, Motion, Run, Track
from frictrack.results import BACKWARD, Sensors
from frictrack.sampling import noise_of_smooth

if TYPE_CHECKING:
    from frictrack.measure.motion import KnownAcceleration
    from frictrack.measure.sensors import Alignment, SensorComparison, SensorRecord
    from frictrack.study import RunTable, TableData

# Standard deviations between the mass that the drive moves and the weighed mass, from which a note is made.
MIN_MASS_DIFFERENCE_SIGMAS = 3.0
MIN_COVERED_SHARE = 0.5  # of the run, that the record of a drive must cover; a wrong offset leaves less
TIME_TOLERANCE_S = 1e-9  # s
MIN_FRAMES_OF_TARGET = 8  # frames needed to decide whether a target moves with the mass
MIN_GAIN = 0.5  # displacement of the target per displacement of the mass, from which it may be fixed to the mass
MAX_OTHER_MOTION = 0.02  # share of its squared motion that may be independent of the mass


def read_sensors(pipeline: RunPipeline, displacement: Displacement) -> Sensors:
    """Read drive, acceleration and friction force of a run, at the frames of the camera.

    Columns of the run's own table are used as they are, because their clock is the camera's.
    """
    run, reader = pipeline.run, _SensorReader(displacement)
    if run.table:
        own = study.read_run_table(run)
        if any(column is not None for column in (own.drive, own.friction, own.a)):
            reader.add_own_columns(measure.table_clock.with_even_clock(own), run.table.name)
    if run.drive is not None:
        short = {"table": run.drive} if isinstance(run.drive, Path) else {"force": run.drive}
        reader.add_drive(run.drive if isinstance(run.drive, dict) else short)
    if run.sensor is not None:
        reader.add_sensor(run.sensor if isinstance(run.sensor, dict) else {"table": run.sensor})
    return Sensors(displacement.t, **reader.found, clocks=reader.clocks, notes=tuple(reader.notes))


def fused_acceleration(sensors: Sensors) -> KnownAcceleration | None:
    """Return the acceleration of the sensor for the smoother, without its gain and bias."""
    if sensors.known_a is None or sensors.sigma_known_a is None:
        return None
    return measure.motion.KnownAcceleration(sensors.known_a, sensors.sigma_known_a)


def sensor_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Summarise sensors and impact of a run, for the JSON of `motion` and `friction`."""
    sensors: Sensors = pipeline.get("sensors")
    notes = [*sensors.notes, *_moved_mass_notes(pipeline.run, sensors)]
    impact = _impact_energy(pipeline)
    if impact and impact["verdict"] != "plausible":
        notes.append(impact["says"])
    return {"sensors": sensors.clocks, "impact": impact, "notes": notes}


class _SensorReader:
    """Collect what the sensors of one run measured."""

    def __init__(self, displacement: Displacement) -> None:
        self.displacement = displacement
        self.interval = float(np.median(np.diff(displacement.t)))  # of the frames, s
        self.found: dict[str, Any] = {}
        self.clocks: dict[str, Any] = {}
        self.notes: list[str] = []

    def add_own_columns(self, data: TableData, name: str) -> None:
        """Take columns of the run's own table, whose clock is the camera's."""
        self.found |= {"drive": data.drive, "friction_N": data.friction}
        if data.a is not None:
            self._acceleration(measure.sensors.SensorRecord(data.t, data.a, f"{name}, a_m_s2"), 0.0)

    def add_drive(self, spec: dict[str, Any]) -> None:
        """Read a drive: a constant force or a table, perhaps only up to some time or place."""
        t, until = self.displacement.t, spec.get("until", np.inf)
        needed = "table" in spec or not isinstance(until, float)
        motion = measure.motion.differentiate(measure.motion.low_pass(self.displacement)) if needed else None
        if motion is not None and not isinstance(until, float):
            where = "the release at " if until == "release" else ""
            run = Run(self.displacement, motion, mass=1.0)
            until = measure.friction.release_time(run) if where else _time_at(motion, until["x"])
            self.notes.append(f"drive: none after {where}{until:.4g} s")
        if "force" in spec:
            self.found["drive"] = spec["force"] * _share_until(t, until)
            return
        assert motion is not None
        acting = t <= until
        series = _drive_force(spec)
        found = measure.sensors.align_drive(self.displacement, motion, series, offset=_offset(spec), until=float(until))
        self._note_alignment("drive", series, found)
        self.found["drive"] = self._at_all_frames(series, found, acting)
        if series.interval > self.interval:  # between its samples a curve scatters little, but for long
            scatter = float(np.nan_to_num(noise_of_smooth(series.values)[0]))
            self.found |= {"drive_scatter": scatter, "drive_interval": series.interval}

    def add_sensor(self, spec: dict[str, Any]) -> None:
        """Read an accelerometer, a load cell that measures friction, or both."""
        data = study.read_sensor_table(spec["table"], ("a", "friction"), spec.get("columns", {}))
        name = spec["table"].name
        if data.a is not None:
            self._acceleration(measure.sensors.SensorRecord(data.t, data.a, name), _offset(spec))
        if data.friction is not None:
            series = measure.sensors.SensorRecord(data.t, data.friction, name)
            frames = measure.sensors.second_differences(self.displacement)
            acting = [column[frames.centre] for column in (self.found.get("drive"),) if column is not None]
            varying = [column for column in acting if np.ptp(column) > 0.0]
            regressors = np.stack([*varying, np.ones(len(frames.z))], axis=1)
            found = measure.sensors.align(measure.sensors.AlignmentProblem(frames, series, regressors), _offset(spec))
            self._note_alignment("friction_N", series, found)
            self.found["friction_N"] = self._where_read(series, found)

    def _acceleration(self, series: SensorRecord, offset: float | None) -> None:
        """Align an accelerometer, compare it with the camera, and use it for fusion if both agree."""
        t = self.displacement.t
        frames = measure.sensors.second_differences(self.displacement)
        problem = measure.sensors.AlignmentProblem(frames, series, np.ones((len(frames.z), 1)), series.sigma)
        found = measure.sensors.align(problem, offset)
        values = series.average(t - found.lag(t), frames.interval)
        if not np.any(np.isfinite(values)):
            raise FrictrackError(_no_overlap(series, found, t))
        compared = measure.sensors.compare_with_camera(problem, found, self.displacement.relative_scale_error)
        self._note_alignment("a", series, found, compared)
        self.found["a"] = values
        if compared.verdict == "consistent":
            fused = measure.sensors.known_acceleration(series, found, t)
            self.found |= {"known_a": fused.a, "sigma_known_a": float(fused.sigma)}

    def _note_alignment(
        self, what: str, series: SensorRecord, found: Alignment, compared: SensorComparison | None = None
    ) -> None:
        """Store the numbers of an alignment and describe it in a note."""
        self.clocks[what] = _alignment_to_dict(found, compared)
        if found.sigma_offset is not None:
            value = f"{1e3 * abs(found.offset):.4g} +/- {1e3 * found.sigma_offset:.2g} ms"
            side = "ahead of" if found.offset < 0 else "behind"
            self.notes.append(f"{series.name}: its clock is {value} {side} the camera's; {found.reason}")
        elif not found.reason.startswith("as given"):
            self.notes.append(f"{series.name}: its clock could not be aligned with the camera's: {found.reason}")
        if compared is not None and (found.rivals or compared.verdict != "not compared"):
            self.notes.append(f"{series.name} {_describe_agreement(compared)}")

    def _where_read(self, series: SensorRecord, found: Alignment) -> Array:
        """Return a force (n,) at the frames next to its samples, NaN elsewhere; its record must cover the run."""
        t, half = self.displacement.t, self.interval / 2.0
        at = t - found.lag(t)
        covered = series.covers(at - half, at + half)
        if not (covered[0] and covered[-1]):
            raise FrictrackError(_no_overlap(series, found, t))
        if missing := int(np.sum(~covered)):
            self.notes.append(f"{series.name}: no value at {missing} of {len(t)} frames, which are left out")
        return series.means(at)

    def _at_all_frames(self, series: SensorRecord, found: Alignment, acting: Array) -> Array:
        """Return a force (n,) at all frames: 0 where it does not act, short gaps interpolated; NaN beyond its record.

        A record that covers less than a share of these frames is refused.
        """
        t = self.displacement.t
        values = series.average(t - found.lag(t), self.interval)
        rows, measured = np.flatnonzero(acting), np.flatnonzero(acting & np.isfinite(values))
        span = t[measured[[0, -1]]] if len(measured) else np.array([np.inf, -np.inf])
        inside = rows[(t[rows] >= span[0]) & (t[rows] <= span[1])]
        if len(inside) == 0 or len(inside) < MIN_COVERED_SHARE * len(rows):
            raise FrictrackError(_no_overlap(series, found, t[rows]))
        if missing := len(inside) - len(measured):
            self.notes.append(f"{series.name}: no value at {missing} of {len(rows)} frames; bridged by straight lines")
        if len(inside) < len(rows):
            self.notes.append(f"{series.name} covers {span[0]:.4g} to {span[1]:.4g} s: only this part is fitted")
        return np.where(acting, np.interp(t, t[measured], values[measured], np.nan, np.nan), 0.0)


def _time_at(motion: Motion, place: float) -> float:
    """Time at which the mass first passes a place, s."""
    before = motion.x - place
    passed = np.flatnonzero(np.diff(np.sign(before)))
    if not len(passed):
        span = f"{motion.x.min():.4g} to {motion.x.max():.4g} m"
        raise FrictrackError(f"drive: expected until at a place that the mass passes, {span}, but got {place:.4g} m")
    i = int(passed[0])
    share = before[i] / (before[i] - before[i + 1])
    return float(motion.t[i] + share * (motion.t[i + 1] - motion.t[i]))


def _share_until(t: Array, until: float) -> Array:
    """Share (n,) of a drive that acts at frames t until a time between two of them, so that its impulse is right."""
    share = np.asarray(t <= until, dtype=float)
    i = int(np.sum(share)) - 1
    if 0 <= i < len(t) - 1:
        late = (until - t[i]) / (t[i + 1] - t[i]) - 0.5  # frames beyond the middle of the interval
        share[i + (late > 0)] += late
    return share


def _drive_force(spec: dict[str, Any]) -> SensorRecord:
    """Read the table of a drive, N; a pressure is multiplied by the area."""
    area, columns, path = spec.get("area"), spec.get("columns", {}), spec["table"]
    data = study.read_sensor_table(path, ("drive",) if area is None else ("pressure",), columns)
    values = data.drive if area is None else np.asarray(data.pressure) * area
    assert values is not None
    return measure.sensors.SensorRecord(data.t, values, path.name)


def _offset(spec: dict[str, Any]) -> float | None:
    """Return the given clock offset, s; None if it is to be estimated."""
    given = spec.get("offset", "auto")
    return None if given == "auto" else float(given)


def _no_overlap(series: SensorRecord, found: Alignment, t: Array) -> str:
    """Describe a sensor that does not cover the run."""
    first, last = series.t[0] + found.offset, series.t[-1] + found.offset
    return (
        f"{series.name}: expected values over {t[0]:g} to {t[-1]:g} s, as long as the run, "
        f"but got {first:g} to {last:g} s on the camera's clock ({found.reason}); "
        'correct its offset, as in {table = "..", offset = "1.2 ms"}, or its t_s'
    )


def _describe_agreement(compared: SensorComparison) -> str:
    differ = (
        f"they differ by {compared.rms_difference:.2g} m/s^2 rms in means over "
        f"{1e3 * (compared.window or 0.0):.3g} ms, of which their noises explain {compared.rms_expected:.2g}"
    )
    if compared.verdict == "consistent":
        return "; ".join([f"agrees with the camera: {differ}", *compared.says])
    if compared.verdict == "not compared":
        return "; ".join(["is not used", *compared.says])
    return "; ".join(["disagrees with the camera and is not used", *compared.says, differ])


def _alignment_to_dict(found: Alignment, compared: SensorComparison | None) -> dict[str, Any]:
    """Return an alignment and a comparison as the store and the JSON have them."""
    has_rate, same = found.sigma_rate is not None, ("gain", "sigma_gain", "bias", "sigma_bias", "reason")
    numbers: dict[str, Any] = {
        "offset_s": found.offset,
        "sigma_offset_s": found.sigma_offset,
        "rate_ppm": 1e6 * found.rate if has_rate else None,
        "sigma_rate_ppm": 1e6 * (found.sigma_rate or 0.0) if has_rate else None,
        **{key: getattr(found, key) for key in same},
        "rivals": [list(rival) for rival in found.rivals],
    }
    if compared is not None:
        keys = ("verdict", "p", "reduced_chi2", "rms_difference", "rms_expected", "window")
        numbers |= {key: getattr(compared, key) for key in keys} | {"says": "; ".join(compared.says)}
    return numbers


def _moved_mass_notes(run: RunTable, sensors: Sensors) -> list[str]:
    """Return a note if the drive accelerates another mass than was weighed."""
    clock = sensors.clocks.get("drive", {})
    gain, spread = clock.get("gain"), clock.get("sigma_gain")
    if gain is None or spread is None or not isinstance(run.mass, tuple) or gain < MIN_MASS_DIFFERENCE_SIGMAS * spread:
        return []
    (mass, sigma), moved = run.mass, 1.0 / gain
    spread = spread / gain**2
    if abs(moved - mass) < MIN_MASS_DIFFERENCE_SIGMAS * np.hypot(sigma, spread):
        return []
    return [
        f"the drive moves a mass of {moved:.4g} +/- {spread:.2g} kg but {mass:.4g} kg was weighed: check the drive's "
        "unit and zero (or the piston's area), the scale, the frame rate and what else moves along"
    ]


def _impact_energy(pipeline: RunPipeline) -> dict[str, Any] | None:
    """Compare the kinetic energy at release with `impact_energy`, if that is stated and the mass is known."""
    run = pipeline.run
    if run.impact_energy is None or not isinstance(run.mass, tuple):
        return None
    displacement: Displacement = pipeline.get("displacement")
    motion: Motion = pipeline.get("motion")
    release = result_or_none(measure.friction.release_time, replace(pipeline.to_run(), drive=None, friction_N=None))
    if release is None:  # nothing slides, which the friction stage reports
        return None
    released = int(np.argmin(np.abs(motion.t - release)))
    speed = float(motion.v[released]), float(motion.sigma_v[released])
    energy = measure.sensors.release_energy(run.mass, speed, run.impact_energy, displacement.relative_scale_error)
    return {
        "E_kin_J": energy.kinetic,
        "sigma_J": energy.sigma,
        "E_kin_over_E_impact": energy.share,
        "verdict": energy.verdict,
        "says": energy.says,
    }


def auxiliary_signals(pipelines: Sequence[RunPipeline]) -> dict[str, dict[str, Array]]:
    """Return the auxiliary signals of all fitted runs.

    A target is scaled like the mass but not rotated into the course axis, because only the shape of its signal is used.
    """
    out: dict[str, dict[str, Array]] = {}
    for pipeline in pipelines:
        record = pipeline.to_run()
        if record.role != "fit":
            continue
        found: dict[str, Array] = {}
        for name, track in (pipeline.get("tracks") if "tracks" in pipeline.stages else {}).items():
            if name != BACKWARD:  # a second track of the mass
                found |= _target_signals(name, track, record)
        felt = pipeline.get("sensors").a
        if felt is not None and len(felt) == len(record.displacement):
            found["accelerometer"] = felt
        out[pipeline.run.name] = found
    return out


def _target_signals(name: str, track: Track, record: Run) -> dict[str, Array]:
    """Return both coordinates of a target, m (px without a scale); empty if it moves with the mass."""
    rows = _rows_of_run(track, record)
    if rows is None or not np.any(track.found[rows]):
        return {}
    pitch = record.pixel_pitch or 1.0
    x, y = pitch * track.x_px[rows], pitch * track.y_px[rows]
    if _moves_with_mass(np.stack([x, y], axis=1), record.displacement.x):
        return {}
    return {f"the {name}, right": x - np.nanmean(x), f"the {name}, up": -(y - np.nanmean(y))}


def _rows_of_run(track: Track, record: Run) -> NDArray[np.int64] | None:
    """Return the rows of a track that are the frames of a run; None if their times differ."""
    t = record.displacement.t
    if len(track) == len(t):
        return np.arange(len(t))
    rows = np.searchsorted(track.t, t - TIME_TOLERANCE_S).clip(0, len(track) - 1)
    return rows if np.allclose(track.t[rows], t, rtol=0, atol=TIME_TOLERANCE_S) else None


def _moves_with_mass(place: Array, x: Array) -> bool:
    """Return whether a target at positions (n, 2) moves with the mass, whose displacement is x (n,)."""
    known = np.isfinite(x) & np.all(np.isfinite(place), axis=1)
    if np.count_nonzero(known) < MIN_FRAMES_OF_TARGET:
        return False
    moved, own = place[known] - place[known].mean(axis=0), x[known] - x[known].mean()
    gain = own @ moved / max(float(own @ own), 1e-300)  # (2,) least squares
    other = moved - own[:, None] * gain
    return bool(np.linalg.norm(gain) > MIN_GAIN and np.sum(other**2) < MAX_OTHER_MOTION * np.sum(moved**2))
