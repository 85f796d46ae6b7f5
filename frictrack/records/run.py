"""The record of one run: its motion and the properties of the slider."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from frictrack.base import imported
from frictrack.base.arguments import checked
from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.base.units import parse_quantity
from frictrack.records.frame_table import Array, Displacement, Motion, NotebookView, scalar

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

GRAVITY = 9.80665  # m/s^2, standard
SERIES = ("drive", "friction_N", "sigma_friction", "loads")  # one value per frame of the displacement
ROLLING = {"disc": 0.5, "ball": 0.4, "hollow ball": 2 / 3, "ring": 1.0}  # I / (m r^2)
POSITIVE, ERROR = {"above": 0.0}, {"least": 0.0}  # limits of scalars
STATED = ("noise", "drift")  # of the force where friction was measured, else of the position
EarlierRuns = tuple[tuple[float, float], ...]  # (s since its end, m slid in it) of every run before


@dataclass(frozen=True, eq=False, repr=False)
class Run(NotebookView):
    """One recorded slide: its motion and the properties of the slider.

    The run covers the frames of `motion`; other frames of `displacement`, `drive` and `friction_N` are cut off.

    Parameters
    ----------
    displacement, motion
        The measured displacement, and what `differentiate` made of it.
    mass, sigma_mass
        Sliding mass and its standard deviation, kg. None: it is fitted if the drive is measured; otherwise only
        measured friction can be identified.
    name
        Name of the run.
    incline, sigma_incline
        Angle of the course and its standard deviation, rad; positive if it rises toward +x. With a standard deviation
        the angle is one unknown of the fit: `slope`, with that prior.
    radius, sigma_radius
        Radius of a circular course, along which x counts, and its standard deviation, m; below 0 where it is a crest.
        By default that on which the positions x, y lie. With an incline, that where x is 0, the circle stands upright;
        else it lies flat.
    rolling
        Moment of inertia over m r^2 of a body that rolls without slipping: "disc", "ball", "hollow ball", "ring", or a
        number; 0 for one that slides.
    normal_load
        Normal load, N; by default m g cos(incline); on a circle the sum of weight and m v^2/R, as vectors.
    drive, friction_N
        Measured drive and friction force at the frames of `displacement`, N, (n,). NaN where friction was not read.
    sigma_drive
        Standard deviation of the errors of a measured drive, N, white from sample to sample; 0 for one that is exact.
        By default what it scatters, unless the motion certainly follows this scatter.
    drive_scatter
        That scatter, N, where it is known; by default it is estimated from the drive.
    drive_interval
        Time between the samples of a drive that was read less often than the positions, s: their errors last as long.
    free
        Begin and end of the free section, s, instead of the one that is found.
    clamp_x, beam_length
        Position of the clamp of a beam under the course and its free length, m.
    earlier
        For every earlier run on the same surfaces, the rest since its end (s) and the distance slid in it (m); None
        where it is not known. `with_earlier_runs` makes it from the pauses.
    role
        "fit", or "validation" for a run that is predicted and not fitted.
    group
        Name of a group of runs, for fits per group.
    noise, drift
        Stated white noise and slow error, rms: N if friction was measured, else m.
    has_incline
        Whether gravity drives the run: the free section then starts when motion starts.
    steady
        Whether every row is a measurement of its own at a constant speed, without order in time; see `from_curve`.
    sigma_friction, loads
        Standard deviation of `friction_N` and normal load of every such row, N, (n,), where they are known.

    Raises
    ------
    FrictrackError
        If the parts do not fit together.

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> run.name, run.mass, len(run.motion.t)
    ('fast', 0.35, 150)

    """

    drawn_by: ClassVar[str] = "frictrack.present.plots:motion"
    displacement: Displacement
    motion: Motion
    mass: float | None = scalar("kg", POSITIVE, default=None)
    name: str = "run"
    sigma_mass: float = scalar("kg", ERROR, default=0.0)
    incline: float = scalar("rad", {"above": -np.pi / 2, "below": np.pi / 2}, default=0.0)
    sigma_incline: float = scalar("rad", ERROR, default=0.0)
    radius: float | None = scalar("m", default=None)
    sigma_radius: float = scalar("m", ERROR, default=0.0)
    rolling: float | str = scalar("1", default=0.0)
    normal_load: float | None = scalar("N", POSITIVE, default=None)
    drive: Array | None = None  # N, at displacement.t
    sigma_drive: float | None = scalar("N", ERROR, default=None)
    drive_scatter: float | None = scalar("N", ERROR, default=None)
    drive_interval: float | None = scalar("s", POSITIVE, default=None)
    friction_N: Array | None = None  # N, at displacement.t
    free: tuple[float, float] | None = scalar("s", default=None)
    clamp_x: float | None = scalar("m", default=None)
    beam_length: float | None = scalar("m", POSITIVE, default=None)
    earlier: EarlierRuns | None = None
    role: str = "fit"
    group: str = ""
    noise: float | None = scalar("m", ERROR, default=None)
    drift: float | None = scalar("m", ERROR, default=None)
    has_incline: bool = False
    steady: bool = False
    sigma_friction: Array | None = None  # N, at displacement.t
    loads: Array | None = None  # N, at displacement.t

    def __post_init__(self) -> None:
        faults = []
        self._cut_to_motion()
        for name in ("radius", "sigma_radius") if self.radius is None else ():
            object.__setattr__(self, name, getattr(self.displacement, name))
        for one in fields(self):
            if "unit" in one.metadata and getattr(self, one.name) is not None:
                try:
                    self._convert(one.name, **one.metadata)
                except FrictrackError as e:
                    faults.append(str(e))
        faults += self._faults_of_mass()
        if len(self.displacement) != len(self.motion):
            faults.append(f"expected motion of the same {len(self.displacement)} frames but got {len(self.motion)}")
        for name in SERIES:
            value = getattr(self, name)
            if value is not None and np.shape(value) != (len(self.displacement),):
                faults.append(f"expected {name} at {len(self.displacement)} frames but got {np.shape(value)}")
        if self.role not in ("fit", "validation"):
            faults.append(f'expected role "fit" or "validation" but got "{self.role}"')
        raise_faults(faults, f'run "{self.name}"')

    def _faults_of_mass(self) -> Iterator[str]:
        if self.rolling and self.mass is None:
            yield "expected a mass of a body that rolls but got none; weigh it and give mass"
        if self.radius and self.has_incline and (self.mass is None or self.normal_load is not None):
            yield "expected a mass, and no normal load, of a run on a circle that stands upright: both act"
        if self.mass is None and self.friction_N is None and self.drive is None:
            yield (
                "expected a mass but got none; only runs with measured friction (friction_N), or with a measured drive "
                'and mass = "fit", do without'
            )

    def _convert(self, name: str, unit: str, limits: Mapping[str, float]) -> None:
        """Convert a text with a unit, and perhaps its uncertainty, to a number, and check that."""
        value, unit = getattr(self, name), "N" if name in STATED and self.friction_N is not None else unit
        if name == "free":
            if not isinstance(value, tuple | list) or len(value) != 2:
                raise FrictrackError(f"expected free as (begin, end) in s but got {value!r}")
            value = tuple(parse_quantity(end, unit, name)[0] for end in value)
        elif name == "rolling":
            value = rolling_inertia(value)
        else:
            value, std = parse_quantity(value, unit, name, **limits)
            if std and hasattr(self, f"sigma_{name}"):
                object.__setattr__(self, f"sigma_{name}", std)
        object.__setattr__(self, name, value)

    def plot(self, what: str = "motion") -> Figure:
        """Draw the run.

        Parameters
        ----------
        what
            "motion", or "filters": displacement, velocity, acceleration and force as measured, filtered and smoothed.

        Raises
        ------
        FrictrackError
            For another figure.

        """
        if what not in ("motion", "filters"):
            raise FrictrackError(f'plot: expected "motion" or "filters" but got "{what}"')
        if self.steady:
            raise FrictrackError(
                f'run "{self.name}": expected a record over time but it is a table of speeds and forces; draw its law '
                'with fit.plot("law")'
            )
        return imported(f"frictrack.present.plots:{what}")(self)

    def _cut_to_motion(self) -> None:
        """Cut off the frames before the first and after the last one of the motion."""
        n, first = len(self.displacement), int(np.searchsorted(self.displacement.t, self.motion.t[0]))
        part = slice(first, first + len(self.motion))
        if len(self.motion) == n or not np.array_equal(self.displacement.t[part], self.motion.t):
            return
        object.__setattr__(self, "displacement", self.displacement.rows(part))
        for name in SERIES:
            value = getattr(self, name)
            if np.shape(value) == (n,):
                object.__setattr__(self, name, np.asarray(value)[part])

    @classmethod
    @checked
    def from_arrays(
        cls,
        t: ArrayLike,
        x: ArrayLike,
        *,
        mass: float | str | None = None,
        friction: ArrayLike | None = None,
        drive: ArrayLike | float | None = None,
        sigma: ArrayLike | float | None = None,
        **settings: Any,
    ) -> Run:
        """Make a run of measured positions, whatever measured them.

        The clock is checked, outliers and repeated samples are left out, the noise is estimated where it is not given,
        and the positions are smoothed and differentiated.

        Parameters
        ----------
        t, x
            Time, s, and position along the course, m, (n,).
        mass
            Sliding mass: a number in kg, or a text with its unit, such as ``"350 +/- 1 g"``.
        friction
            Measured friction force, N, (n,): a load cell or a tribometer. It is then identified directly.
        drive
            Measured drive force, N, (n,), or one number.
        sigma
            Standard deviation of x, m, (n,) or one number; estimated by default.
        **settings
            Further parameters of `Run`, such as `name`, `incline` or `normal_load`.

        Returns
        -------
        Run

        Raises
        ------
        FrictrackError
            If shapes differ, a value is not finite, time does not rise, or the mass is missing.

        Warns
        -----
        UserWarning
            If mass, time or positions look like values in another unit.

        Examples
        --------
        A slide that friction of 2 N brakes from 3 m/s:

        >>> import numpy as np
        >>> t = np.arange(0, 0.2, 1 / 4000)
        >>> run = Run.from_arrays(t, 3 * t - 0.5 * 2.0 / 0.35 * t**2, mass=0.35, name="slow")
        >>> float(run.motion.v[0].round(6)), len(run.motion)
        (3.0, 800)

        """
        optional = {"friction": friction, "drive": drive, "sigma": sigma}
        return imported("frictrack.measure.tables:run_of_arrays")(t, x, mass=mass, optional=optional, settings=settings)

    @classmethod
    @checked
    def from_dataframe(
        cls,
        frame: pd.DataFrame,
        *,
        mass: float | str | None = None,
        columns: Mapping[str, str] | None = None,
        **settings: Any,
    ) -> Run:
        """Make a run of a pandas DataFrame; see `from_arrays`.

        Parameters
        ----------
        frame
            One row per sample; columns ``t_s`` and ``x_m``, and perhaps ``sigma_m``, ``y_m``, ``drive_N`` and
            ``friction_N``.
        mass
            Sliding mass: a number in kg, or a text with its unit.
        columns
            Other headers by short name, with their units in parentheses: ``{"t": "Time (ms)", "x": "pos (mm)"}``. A
            leading minus flips the sign.
        **settings
            Further parameters of `Run`.

        Returns
        -------
        Run

        Raises
        ------
        FrictrackError
            If a column is missing or holds something else than numbers, or the mass is missing.

        Warns
        -----
        UserWarning
            If mass, time or positions look like values in another unit.

        Examples
        --------
        >>> import pandas as pd
        >>> frame = pd.DataFrame({"Time (ms)": range(100), "pos (mm)": [0.5 * i for i in range(100)]})
        >>> Run.from_dataframe(frame, mass="350 g", columns={"t": "Time (ms)", "x": "pos (mm)"}).mass
        0.35

        """
        make = imported("frictrack.measure.tables:run_of_dataframe")
        return make(frame, columns or {}, mass, settings)

    @classmethod
    @checked
    def from_curve(
        cls,
        v: ArrayLike,
        friction: ArrayLike | None = None,
        *,
        mu: ArrayLike | None = None,
        sigma: ArrayLike | float | None = None,
        load: ArrayLike | float | str | None = None,
        **settings: Any,
    ) -> Run:
        """Make a run of a bench that measures friction at constant speeds: points (v, F) without order in time.

        Only the law over the speed is identified: nothing that depends on time, place or the motion before. The noise
        is `sigma`; else the scatter of repeated speeds; else what the force scatters about a smooth course over speed.

        Parameters
        ----------
        v
            Speed, m/s, (n,), in any order; below 0 in the other direction.
        friction, mu
            Friction force, N, or its coefficient, (n,); one of the two. Its sign is that of v; a force that is positive
            in both directions is the force against the motion.
        sigma
            Standard deviation of that, (n,) or one number.
        load
            Normal load, N, (n,) or one number. Without it, coefficients are forces per newton of load.
        **settings
            Further parameters of `Run`, such as `name`, `group` or `mass`.

        Returns
        -------
        Run

        Raises
        ------
        FrictrackError
            If shapes differ, a value is not finite, or there are fewer than five points.

        Examples
        --------
        >>> import numpy as np
        >>> v = np.geomspace(0.01, 1, 20)
        >>> Run.from_curve(v, mu=0.2 + 0.1 * np.exp(-v / 0.1), load="50 N", name="oil")
        <Run "oil": 20 points, 0.01 to 1 m/s, 10 to 14.52 N>

        """
        deviation = "sigma_friction" if mu is None else "sigma_mu"
        columns = {"v": v, "friction": friction, "mu": mu, deviation: sigma, "load": load}
        return imported("frictrack.measure.tables:run_of_curve")(columns, settings)

    def __repr__(self) -> str:
        if self.steady and self.friction_N is not None:
            v, force = self.motion.v, self.friction_N
            spans = f"{v.min():.4g} to {v.max():.4g} m/s, {force.min():.4g} to {force.max():.4g} N"
            return f'<Run "{self.name}": {len(v)} points, {spans}>'
        x, t = self.displacement.x[self.displacement.known], self.displacement.t
        mass = "no mass" if self.mass is None else f"{self.mass:.6g} kg"
        more = "".join(f", {name} measured" for name in ("drive", "friction_N") if getattr(self, name) is not None)
        span = f"{t[0]:.6g} to {t[-1]:.6g} s, {x.min():.4g} to {x.max():.4g} m"
        return f'<Run "{self.name}": {len(t)} frames, {span}, {mass}{more}>'

    def to_dataframe(self) -> pd.DataFrame:
        """Return the measured and the smoothed motion as a pandas DataFrame, one row per frame.

        Columns ``x_measured`` and ``sigma_measured`` are the measured position and its standard deviation, those of
        `Motion` follow, then ``drive`` and ``friction_N`` where they were measured; ``attrs["units"]`` holds the units.
        """
        frame, units = self.motion.to_dataframe(), {}
        measured = {"x_measured": (self.displacement.x, "m"), "sigma_measured": (self.displacement.sigma_x, "m")}
        forces = {"drive": (self.drive, "N"), "friction_N": (self.friction_N, "N")}
        for place, (name, (values, unit)) in enumerate(measured.items(), 1):
            frame.insert(place, name, values)
            units[name] = unit
        for name, (force, unit) in forces.items():
            if force is not None:
                frame[name], units[name] = force, unit
        frame.attrs["units"] = {**frame.attrs["units"], **units}
        return frame

    @property
    def pixel_pitch(self) -> float | None:
        """Size of a pixel on the course, m; None without a camera."""
        return self.displacement.pixel_pitch

    @property
    def inertia(self) -> float | None:
        """What resists acceleration, kg: the mass, and I / r^2 of a body that rolls; None without a mass."""
        return None if self.mass is None else self.mass * (1.0 + float(self.rolling))

    @property
    def straight_incline(self) -> float:
        """Incline of a straight course, rad; 0 of a circle, of which `incline` tells where it is level."""
        return 0.0 if self.radius else self.incline

    @property
    def pull(self) -> float:
        """Acceleration toward +x by gravity alone, m/s^2; 0 on a circle, where it is the effect `gravity`."""
        return -GRAVITY * float(np.sin(self.straight_incline)) / (1.0 + float(self.rolling))

    @property
    def load(self) -> float | None:
        """Normal load, N: as given (of points, their mean), else m g cos(incline); None without a mass."""
        if self.loads is not None:
            return float(np.mean(self.loads))
        if self.normal_load is not None:
            return self.normal_load
        return None if self.mass is None else self.mass * GRAVITY * float(np.cos(self.straight_incline))


def rolling_inertia(shape: float | str) -> float:
    """Read the moment of inertia over m r^2 of a body that rolls.

    Raises
    ------
    FrictrackError
        If it is no known shape, and no number from 0 to 1.

    Examples
    --------
    >>> rolling_inertia("disc"), rolling_inertia(0.45)
    (0.5, 0.45)

    """
    value = ROLLING.get(shape) if isinstance(shape, str) else shape
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value <= 1:
        raise FrictrackError(
            f"expected rolling to be {', '.join(ROLLING)} or a number from 0 to 1, I/(m r^2), but got {shape!r}"
        )
    return float(value)
