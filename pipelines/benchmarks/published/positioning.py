"""Score the EMPS: relative force error on the half of the validation record that nothing was chosen or fitted on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from identification import screen
from identification.emps import ASYMMETRIC, PUBLISHED, Record, authors, records

from .flexibility import friction_of, joint_search, noise_floor, transfer

Row = dict[str, Any]
Say = Callable[[str], None]


def score(folder: Path, say: Say) -> dict[str, Any]:
    """All figures of the two records."""
    data = records(folder)
    rows: list[Row] = [
        {
            "what": f"{r['model']}, the published method",
            "published": PUBLISHED[r["model"]]["validation"],
            "ours": r["errors"]["validation"],
            "unit": "%",
        }
        for r in authors(data)
    ]
    first, second = _halves(data["validation"])
    start = screen.Law({name: {} for name in ASYMMETRIC.split(",")})
    late = screen.timed(data["train"], start)
    title = f"asymmetric, drive {1e3 * late.late:.2f} ms late, fitted on train"
    rows.append(_row(title, start, late, data["validation"]))
    for law, record, _ in screen.grown(first, start, say):
        rows.append(_row(f"{law.words}, drive {1e3 * record.late:.2f} ms late, second half", law, record, second))
    return {"rows": rows, "flexibility": _flexibility(data)}


def _halves(record: Record) -> tuple[Record, Record]:
    n = len(record.q) // 2
    return Record(record.q[:n], record.drive[:n]), Record(record.q[n:], record.drive[n:])


def _row(what: str, law: screen.Law, fitted: Record, scored: Record) -> Row:
    found = np.linalg.lstsq(law.columns(fitted), fitted.force, rcond=None)[0]
    told = replace(scored, late=fitted.late)
    return {"what": what, "published": None, "ours": told.error(found, law.columns(told)), "unit": "%"}


def _flexibility(data: dict[str, Record]) -> dict[str, Any]:
    record = screen.timed(data["validation"], screen.Law({name: {} for name in ASYMMETRIC.split(",")}))
    law = screen.Law({name: {} for name in ASYMMETRIC.split(",")})
    mass, dry, viscous, uneven, uneven_viscous = np.linalg.lstsq(law.columns(record), record.force, rcond=None)[0]
    friction = friction_of(data["validation"], np.array([dry, viscous, uneven, uneven_viscous]))
    found = joint_search(transfer(data["validation"], friction, float(mass)))
    return found | {"noise_floor_m_per_rtHz": {role: noise_floor(r) for role, r in data.items()}}
