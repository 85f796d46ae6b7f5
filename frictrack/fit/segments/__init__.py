"""Cut runs into the pieces that a model is fitted to: stretches of motion, release, noise, segment lengths."""

from frictrack.fit.segments.acceleration_chain import AccelerationChain, acceleration_chains, acceleration_noise
from frictrack.fit.segments.joined import JoinedPieces, group_by_size, split_motions
from frictrack.fit.segments.lengths import cut_into_segments, has_known_history, segment_frames
from frictrack.fit.segments.mass_units import guess_mass, in_mass_units
from frictrack.fit.segments.pieces import (
    MIN_FRAMES,
    Piece,
    Rows,
    joined_whitening,
    noise_free_remark,
    path_of_rows,
    spans_of,
    whole_piece,
)
from frictrack.fit.segments.release import Reference, RunContext, reference_of, run_context
from frictrack.fit.segments.sections import sections_of

__all__ = [
    "MIN_FRAMES",
    "AccelerationChain",
    "JoinedPieces",
    "Piece",
    "Reference",
    "Rows",
    "RunContext",
    "acceleration_chains",
    "acceleration_noise",
    "cut_into_segments",
    "group_by_size",
    "guess_mass",
    "has_known_history",
    "in_mass_units",
    "joined_whitening",
    "noise_free_remark",
    "path_of_rows",
    "reference_of",
    "run_context",
    "sections_of",
    "segment_frames",
    "spans_of",
    "split_motions",
    "whole_piece",
]
