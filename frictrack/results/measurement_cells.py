"""How well a film was measured, as cells of a table: the same on the terminal and in the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from frictrack.base.number_format import format_number, format_quantity

MIN_SIGMAS_LOCKING = 3.0  # standard deviations from which peak locking counts as found


def measurement_cells(found: Mapping[str, Any]) -> tuple[str, ...]:
    """Return deviation (px, µm), score, peak locking, backward difference, noise floor, shake, blur, exposure.

    Examples
    --------
    >>> found = {"sigma_px": 0.0014, "score": 0.999, "peak_locking_px": 0.005, "peak_locking_std_px": 0.003}
    >>> measurement_cells(found)[:4]
    ('0.0014', '–', '0.999', 'none')

    """
    locking, std, shake = found.get("peak_locking_px"), found.get("peak_locking_std_px"), found.get("shake_px")
    is_locked = locking is not None and std is not None and locking > MIN_SIGMAS_LOCKING * std
    return (
        *(format_number(found.get(key), 2) for key in ("sigma_px", "sigma_um")),
        format_number(found.get("score")),
        format_quantity(locking, std, "") if is_locked else format_number(None) if locking is None else "none",
        *(format_number(found.get(key), 2) for key in ("forward_backward_px", "noise_floor_px")),
        "none" if shake == 0 else format_number(shake, 2),
        format_number(found.get("blur_px"), 2),
        format_number(1e6 * found["exposure_s"] if found.get("exposure_s") else None),
    )
