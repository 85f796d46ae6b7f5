"""Compute the stretches of all runs that a model can be followed along, with white or correlated noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from frictrack.fit.segments.pieces import Piece, pieces_of
from frictrack.fit.segments.release import Reference
from frictrack.friction import free_section
from frictrack.motion import CorrelatedNoise, NoiseStretch, correlated_noise
from frictrack.records import Array, Run

_STRETCHES: WeakKeyDictionary[Run, NoiseStretch] = WeakKeyDictionary()  # the last one of a run: every model asks for it


def sections_of(runs: Sequence[Run], reference: Reference, *, through_reversals: bool) -> list[list[Piece]]:
    """Compute the stretches of every run: pieces of one direction, or longer ones if the model passes reversals.

    Where the noise is not stated, its correlation between neighbouring frames is estimated from all runs together.

    Parameters
    ----------
    runs : sequence of Run
        The runs.
    reference : Reference
        Mass and load at which newtons are reported.
    through_reversals : bool
        Whether the model passes stops and reversals.

    Returns
    -------
    list of list of Piece
        Stretches of every run.

    """
    sections = [
        pieces_of(run, i, free_section(run)[0], reference, through_reversals=through_reversals)
        for i, run in enumerate(runs)
    ]
    unstated = [
        not run.noise and not run.displacement.resolution for run in runs
    ]  # noise neither stated nor due to rounding
    estimated = [i for i, own in enumerate(unstated) if own]
    found = correlated_noise([_noise_stretch(runs[i], _longest_gapless(sections[i])) for i in estimated])
    if found is not None:
        for i, rms in zip(estimated, found.rms.tolist(), strict=True):
            sections[i] = [_with_correlated_noise(p, found, rms) for p in sections[i]]
    return sections


def _noise_stretch(run: Run, positions: Array) -> NoiseStretch:
    """The stretch of a run with its noise, the one of an earlier fit if the positions are the same."""
    known = _STRETCHES.get(run)
    if known is None or not np.array_equal(known.positions, positions):
        known = _STRETCHES[run] = NoiseStretch(positions)
    return known


def _longest_gapless(section: Sequence[Piece]) -> Array:
    """Measured positions of the longest stretch of a run without a missing frame."""
    parts = [part for p in section for part in np.split(p.y, np.flatnonzero(np.diff(p.frames) != 1) + 1)]
    return max(parts, key=len)


def _with_correlated_noise(piece: Piece, found: CorrelatedNoise, rms: float) -> Piece:
    """The same piece with noise of `rms` (m) that is correlated between neighbouring frames."""
    time = -float(np.median(np.diff(piece.t))) / float(np.log(found.correlation))
    level = rms * float(np.sqrt((1 - found.share) / np.mean(piece.sigma**2)))
    return replace(piece, sigma=level * piece.sigma, correlated=(rms * float(np.sqrt(found.share)), time))
