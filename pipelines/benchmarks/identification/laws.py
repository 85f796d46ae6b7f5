"""Compare laws of the EMPS: published, reproduced, frictrack's fit, and with effects added from the library."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import machine_fit, screen
from .emps import ASYMMETRIC, PUBLISHED, SYMMETRIC, Record, authors, records

Say = Callable[[str], None]
Rows = list[dict[str, Any]]
FORCE_DOMAIN, OURS = "force domain, least squares", "frictrack, displacement"


def compare(folder: Path, say: Say) -> dict[str, Rows]:
    """All laws on both records. Effects are chosen on the first; what the second says is looked at afterwards."""
    data = records(folder)
    reproduced = authors(data)
    say(printed(reproduced))
    run = machine_fit.filmed(data["train"])
    laws = {law: screen.Law({name: {} for name in law.split(",")}) for law in PUBLISHED}
    rows: Rows = []
    for title, law in laws.items():
        row = next(r for r in reproduced if r["model"] == title)
        rows += [{"way": FORCE_DOMAIN, "model": law.words, "late": 0.0} | row, own(law, data, 0.0, run)]
    say("\neffects beside the asymmetric law, held-out error on the record to fit")
    for law, record, found in screen.grown(data["train"], laws[ASYMMETRIC], say):
        rows += [chain(law, data, record.late) | found, own(law, data, record.late, run) | found]
    say(table(rows))
    return {"reproduced": reproduced, "laws": rows}


def chain(law: screen.Law, data: Mapping[str, Record], late: float) -> dict[str, Any]:
    """A law by least squares in the authors' measure, its drive late by so much."""
    shifted = {role: replace(record, late=late) for role, record in data.items()}
    columns = {role: law.columns(record) for role, record in shifted.items()}
    found = np.linalg.lstsq(columns["train"], shifted["train"].force, rcond=None)[0]
    errors = {role: record.error(found, columns[role]) for role, record in shifted.items()}
    return {
        "way": FORCE_DOMAIN,
        "model": law.words,
        "late": late,
        "parameters": {"M": float(found[0])},
        "errors": errors,
    }


def own(law: screen.Law, data: Mapping[str, Record], late: float, run: Any) -> dict[str, Any]:
    """The same law found by frictrack in the displacement, told in the authors' measure."""
    numbers = screen.in_one(law, replace(data["train"], late=late))
    found = machine_fit.fitted(machine_fit.timed(run, late), numbers)
    errors = {role: machine_fit.scored(found, replace(record, late=late)) for role, record in data.items()}
    return {"way": OURS, "model": law.words, "late": late, "errors": errors} | machine_fit.figures(found)


def printed(rows: Rows) -> str:
    """Published figures beside those reproduced."""
    lines = [f"\n{'the authors: published, reproduced':36}{'published':>12}{'here':>12}{'apart':>10}"]
    for row in rows:
        lines.append("symmetric" if row["model"] == SYMMETRIC else "asymmetric")
        for name, value in (row["parameters"] | row["errors"]).items():
            known = row["printed"][name]
            lines.append(f"    {name:32}{known:>12.4f}{value:>12.4f}{value / known - 1:>10.1e}")
    return "\n".join(lines)


def table(rows: Rows) -> str:
    """One law per line: relative force error of both records, in the authors' measure."""
    lines = [
        f"\n{'relative force error, %':30}{'late ms':>8}{'M kg':>16}{'train':>8}{'held out':>9}{'validation':>11}  law"
    ]
    for row in rows:
        error = row["errors"]
        head = f"{row['way']:30}{1e3 * row['late']:>8.3f}{_mass(row['parameters']):>16}{error['train']:>8.3f}"
        lines.append(f"{head}{row.get('heldout', np.nan):>9.3f}{error['validation']:>11.3f}  {row['model']}")
    return "\n".join(lines)


def _mass(parameters: Mapping[str, Any]) -> str:
    stated = parameters.get("mass.m")
    return f"{parameters['M']:.3f}" if stated is None else f"{stated['value']:.2f} +/- {stated['std']:.2f}"
