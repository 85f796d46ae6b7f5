"""Pieces: the parts of runs that a model is fitted to, each as one. They are cut, whitened and laid end to end."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.pieces.acceleration_chain import AccelerationChain, acceleration_chains, acceleration_noise
from frictrack.fit.pieces.cutting import (
    MIN_FRAMES,
    Reference,
    RunContext,
    guess_mass,
    noise_free_remark,
    path_of_rows,
    pieces_of,
    reference_of,
    run_context,
    whole_piece,
)
from frictrack.fit.pieces.lengths import cut_into_pieces, has_known_history, piece_frames
from frictrack.fit.pieces.piece import (
    JoinedPieces,
    Piece,
    Rows,
    consecutive_slices,
    displacement_rows,
    group_by_size,
    spans_of,
    split_motions,
    without_starts,
)
