"""Runs cut into the pieces that a model is fitted to: sections of motion, release, noise whitening, segment lengths."""

from frictrack.fit.segments.acceleration_chain import Chain, chains_of, noise_of
from frictrack.fit.segments.lengths import divided, knows_its_past, segment_frames
from frictrack.fit.segments.mass_units import guessed, in_units
from frictrack.fit.segments.pieces import MIN_FRAMES, Piece, Rows, path_of_rows, spans_of, whole_piece
from frictrack.fit.segments.release import Begin, Reference, begin_of, reference_of
from frictrack.fit.segments.sections import sections_of

__all__ = [
    "MIN_FRAMES",
    "Begin",
    "Chain",
    "Piece",
    "Reference",
    "Rows",
    "begin_of",
    "chains_of",
    "divided",
    "guessed",
    "in_units",
    "knows_its_past",
    "noise_of",
    "path_of_rows",
    "reference_of",
    "sections_of",
    "segment_frames",
    "spans_of",
    "whole_piece",
]
