"""Define the shapes of the summaries that `flow` returns and the command line prints with ``--json``."""

from __future__ import annotations

from typing import Any, TypedDict


class Events(TypedDict):
    """Events of a run.

    Attributes
    ----------
    events
        "kind" (release, impact, stop, start, reversal), "from_s" and "to_s" of each event.
    noise_at_rest_um
        Noise while the mass rests, um rms; None if it never rests.

    """

    events: list[dict[str, Any]]
    noise_at_rest_um: float | None


class CutoffSummary(TypedDict):
    """Error of the acceleration (or of m a) with a plain low-pass, and with the smoother that is used.

    Attributes
    ----------
    chosen_Hz, least_Hz
        Cut-off of highest likelihood (or as given), and that of the smallest error, Hz.
    unit
        "N" if the mass is known, else "m/s^2".
    noise, lost
        Noise that passes the chosen low-pass and signal that it removes, rms, in that unit.
    followed_apart
        Error of the smoother that separates trend, vibrations and events, rms, in that unit.
    warnings
        Sentences.

    """

    chosen_Hz: float
    least_Hz: float
    unit: str
    noise: float
    lost: float
    followed_apart: float
    warnings: list[str]


class ImpactEnergy(TypedDict):
    """Kinetic energy at release against the stated energy of the impact.

    Attributes
    ----------
    E_kin_J, sigma_J
        Kinetic energy and its standard deviation, J.
    E_kin_over_E_impact
        Kinetic energy over the stated energy.
    verdict
        "plausible", or what is wrong.
    says
        A sentence.

    """

    E_kin_J: float
    sigma_J: float
    E_kin_over_E_impact: float
    verdict: str
    says: str


class SensorSummary(TypedDict):
    """What other instruments measured in a run.

    Attributes
    ----------
    sensors
        Alignment of every clock, by "drive", "a" or "friction_N".
    impact
        None if the energy of the impact is not stated.
    notes
        Sentences.

    """

    sensors: dict[str, Any]
    impact: ImpactEnergy | None
    notes: list[str]


class Measurements(TypedDict):
    """JSON of `frictrack track`, `motion` and `friction`.

    Attributes
    ----------
    runs
        One row per run; see `frictrack.flow.stored_results`.
    warnings
        Implausible numbers of the study.
    output
        Folder of the results.

    """

    runs: list[dict[str, Any]]
    warnings: list[dict[str, Any]]
    output: str


class ModelChange(TypedDict):
    """JSON of `frictrack add` and `remove`.

    Attributes
    ----------
    effect
        The effect that was added or removed.
    error_before, error_after
        Errors of the model before and after; see `frictrack.compare`.
    parameters
        Parameters of the new model: "value", "std", "unit", ... by name.

    """

    effect: str
    error_before: dict[str, Any]
    error_after: dict[str, Any]
    parameters: dict[str, Any]


class StudySummary(TypedDict):
    """JSON of `frictrack run`.

    Attributes
    ----------
    fit, diagnose
        JSON of those commands.
    warnings
        Implausible numbers of the study.
    output
        Folder of the results.

    """

    fit: dict[str, Any]
    diagnose: dict[str, Any]
    warnings: list[dict[str, Any]]
    output: str


class DemoSummary(TypedDict):
    """JSON of `frictrack demo`.

    Attributes
    ----------
    diagnose
        The first diagnosis.
    add
        The first effect that was added; None if the first model was complete.
    history
        All models tried.
    report
        Path of the report.

    """

    diagnose: dict[str, Any]
    add: ModelChange | None
    history: dict[str, Any]
    report: str


class Verification(TypedDict):
    """JSON of `frictrack verify`.

    Attributes
    ----------
    sound
        Whether there are no faults.
    files, studies
        Number of HDF5 files and of study files.
    faults
        "file", "group", "what", "do", "kind" and "words" of every fault.
    without_checksums
        Files of an earlier schema.
    partly_hashed
        Results whose film is identified by the hash of some of its bytes, as earlier versions did.
    at_work
        Folders in which another process is writing.

    """

    sound: bool
    files: int
    studies: int
    faults: list[dict[str, Any]]
    without_checksums: list[str]
    partly_hashed: list[str]
    at_work: list[str]
