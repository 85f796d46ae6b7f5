"""Define the frozen records that pass from stage to stage; their fields are in SI units and are checked once.

Most records are tables: one row per frame, with NumPy columns of the same length that are read-only. The metadata of a
field names its unit, which the store writes beside the numbers. NaN means "not measured in this frame" in the columns
that allow it. The comments beside the fields appear in ``store/SCHEMA.md``.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.records.frame_table import (
    INTERPOLATED,
    MEASURED,
    Array,
    Curve,
    CutoffTradeOff,
    Displacement,
    Filtered,
    FrameTable,
    Friction,
    Mask,
    ModelledMotion,
    Motion,
    NotebookView,
    Point,
    RunEvents,
    Track,
    away_from_ends,
    column,
    mask_of_spans,
    scalar,
    stretches,
)
from frictrack.records.run import GRAVITY, ROLLING, EarlierRuns, Run, rolling_inertia
