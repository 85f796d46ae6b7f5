"""Repair a track: track some frames again, interpolate them, or leave them out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.recording import Recording, random_access
from frictrack.records import INTERPOLATED, MEASURED, Array, Displacement, Track
from frictrack.repairing.interpolation import interpolated
from frictrack.repairing.retracking import track_again
from frictrack.repairs import LEFT_OUT, MEANINGS, Repair, read_repairs, repair_codes
from frictrack.tracking import TargetModel, relearn_target

REASON_INTERPOLATED, REASON_LEFT_OUT = "interpolated", "left out by the user"
LONG_GAP_SIGMAS = 10.0  # standard deviation of an interpolated position over that of a measured one, which is reported


def repair(
    track: Track,
    recording: Recording | None,
    repairs: Sequence[Mapping[str, Any] | Repair],
    *,
    known: TargetModel | None = None,
) -> Track:
    """Repair frames in which the target was tracked wrongly or lost.

    Parameters
    ----------
    track : Track
        Track of the film, as `track` returns it.
    recording : Recording or None
        The film; None if no frame is tracked again.
    repairs : list of dict
        One table per span of frames: ``{"from": 120, "to": 160, "how": "track", "frame": 130, "target": [x, y, w, h]}``
        (frame numbers, both included). "track" finds the target again from `target`, a rectangle or polygon in px in
        frame `frame`, by default the first one: it tells where the target is, its size and exact place do not matter.
        "interpolate" bridges the frames by the smoothed motion. "leave_out" treats them as lost.
    known : TargetModel, optional
        Model of the target, as `learn_target` returns it; learnt from the film again if it is not given.

    Returns
    -------
    Track
        Frames that were repaired are marked in `repaired`: 1 tracked again, 2 interpolated, 3 left out. Interpolated
        positions count nowhere as data.

    Raises
    ------
    FrictrackError
        For a repair beyond the film, repairs that overlap, or a target that is not recognised.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> track = ft.track(film)
    >>> repaired = ft.repair(track, film, [{"from": 60, "to": 69, "how": "interpolate"}])
    >>> int(repaired.found.sum()), bool(abs(repaired.x_px[65] - track.x_px[65]) < 0.1)
    (137, True)

    """
    found = read_repairs(repairs)
    shape = None if recording is None else recording.shape
    for one in found:
        one.check(len(track), shape)
    codes = repair_codes(found, len(track))
    result = _without(track.measured, codes > 0)
    again = [one for one in found if one.how == "track"]
    if again:
        result = _track_all_again(result, track.measured, recording, again, known, codes)
    for one in found:
        if one.how == "interpolate":
            result = interpolated(result, one)
    reason = result.reason.astype(object)
    for code, text in ((INTERPOLATED, REASON_INTERPOLATED), (LEFT_OUT, REASON_LEFT_OUT)):
        reason[codes == code] = text
    result = replace(result, reason=reason.astype(str), repaired=codes if np.any(codes) else None)
    return replace(result, notes=(*track.notes, *_notes(result, found)))


def repaired_rows(displacement: Displacement, repairs: Sequence[Repair]) -> Displacement:
    """Leave rows of a table out; the smoothed motion bridges them.

    Parameters
    ----------
    displacement : Displacement
        Positions of a table.
    repairs : sequence of Repair
        Repairs with how = "interpolate" or "leave_out".

    Returns
    -------
    Displacement
        Without positions in these rows, which are marked in `repaired`.

    Raises
    ------
    FrictrackError
        For a repair beyond the table.

    """
    if not repairs:
        return displacement
    for one in repairs:
        one.check(len(displacement))
    codes = repair_codes(repairs, len(displacement))
    hidden = np.where(codes > 0, np.nan, 0.0)
    return replace(
        displacement,
        x=displacement.x + hidden,
        y=displacement.y + hidden,
        valid=displacement.valid & (codes == 0),
        notes=(*displacement.notes, _listed(repairs)),
        repaired=codes,
    )


def _track_all_again(
    track: Track,
    unrepaired: Track,
    recording: Recording | None,
    again: Sequence[Repair],
    known: TargetModel | None,
    codes: Any,
) -> Track:
    """Track the frames of several repairs again; the film is opened once."""
    if recording is None:
        raise FrictrackError('expected the recording of the track for how = "track" but got none')
    with random_access(recording) as film:
        model = known or relearn_target(film, unrepaired)
        for one in again:
            track = track_again(film, track, one, model, codes == 0)
    return track


def _without(track: Track, rows: Any) -> Track:
    """Return a track without positions in some frames."""
    hidden = np.where(rows, np.nan, 0.0)
    return replace(track, **{name: q + hidden for name in MEASURED if (q := getattr(track, name)) is not None})


def _notes(track: Track, repairs: Sequence[Repair]) -> tuple[str, ...]:
    """One note on all repairs, and one on each gap over which the position is poorly known."""
    if not repairs:
        return ()
    return (_listed(repairs), *(note for one in repairs for note in _gap_note(track, one)))


def _listed(repairs: Sequence[Repair]) -> str:
    """One sentence that lists the repairs."""
    return "repaired by the user: " + ", ".join(f"{one.frames_text} {MEANINGS[one.how]}" for one in repairs)


def _gap_note(track: Track, one: Repair) -> tuple[str, ...]:
    """Note that a gap is too long for its interpolated positions to be well known; at most one."""
    part = slice(one.first, one.last + 1)
    if one.how == "track":
        lost = int(np.count_nonzero(~track.found[part]))
        return (f"{lost} of the {one.frames_text} that were tracked again are lost",) if lost else ()
    if one.how == "leave_out":
        return ()
    usual, largest = float(np.median(_path_sigma(track)[track.found])), float(np.max(_path_sigma(track)[part]))
    if largest <= LONG_GAP_SIGMAS * usual:
        return ()
    return (
        f"the gap of {one.frames_text} is long: interpolated positions are known to {largest:.2g} px there, measured "
        f"ones to {usual:.2g} px",
    )


def _path_sigma(track: Track) -> Array:
    """Larger standard deviation (n,) of both axes, px."""
    return np.maximum(track.sigma_px, track.sigma_y_px)
