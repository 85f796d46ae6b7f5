"""Diagnose measurements made by others, and print the verdicts.

    python pipelines/benchmarks/diagnosis_real.py --emps FOLDER --tribometer FILE [--seconds 24.8]

EMPS (Janot, Gautier, Brunot 2019): the relative force error in the authors' measure (their filter, trim and decimation;
norm of the drive) with one effect more at a time, fitted on either record; then the symmetric law is diagnosed.
Tribometer (FrictionModels.jl): a law without memory is diagnosed; held-out errors in N.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

from identification import screen
from identification.emps import PUBLISHED, Record, records
from identification.machine_fit import filmed, fitted, scored, timed

import frictrack as ft
from frictrack.study import read_table

Numbers = dict[str, Mapping[str, float]]
COLUMNS = {"t": "Time [s]", "x": "Position [mm]", "friction": "-Friction [uN]"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--emps", type=Path, help="folder of DATA_EMPS.mat")
    parser.add_argument("--tribometer", type=Path, help="test_data_2.txt, or a part of it")
    parser.add_argument("--seconds", type=float, default=24.8, help="of the EMPS record that is diagnosed")
    args = parser.parse_args()
    if args.emps:
        emps(records(args.emps), args.seconds)
    if args.tribometer:
        tribometer(args.tribometer)


def emps(data: Mapping[str, Record], seconds: float) -> None:
    """The force error with one effect more at a time, fitted on either record; then what a diagnosis names."""
    for law, printed in PUBLISHED.items():
        print(f"EMPS, published, {law}: {printed['train']:.3f} %, validation {printed['validation']:.3f} %", flush=True)
    for role in data:
        print(f"  fitted on the {role} record: error on train, on validation", flush=True)
        for words, numbers, late in steps(data[role]):
            found = fitted(timed(filmed(data[role]), late), numbers)
            errors = [scored(found, replace(data[r], late=late)) for r in ("train", "validation")]
            print(f"    {words:52} {errors[0]:.3f} % {errors[1]:.3f} %", flush=True)
    record = data["train"]
    whole = filmed(record)
    squared = ft.effects.formula("uneven", "F * v^2 + D", units={"F": "N s^2/m^2", "D": "N"})
    other = ft.fit(ft.models.parse("coulomb,viscous") + squared, [whole])
    print(f"  asymmetry as v^2 instead of |v|: {scored(other, record):.3f} %: the form in v is not settled", flush=True)
    part = int(seconds * record.rate)
    print_diagnosis(ft.fit("coulomb,viscous", [filmed(Record(record.q[:part], record.drive[:part]))]))


def steps(record: Record) -> Iterator[tuple[str, Numbers, float]]:
    """Laws with one effect more each, the numbers inside them, and how late the drive acts, s, as the record has it."""
    law = screen.Law({"coulomb": {}, "viscous": {}})
    yield "coulomb, viscous", screen.in_one(law, record), 0.0
    law = screen.Law({**law.numbers, "asymmetry": {}})
    yield "+ asymmetry", screen.in_one(law, record), 0.0
    record = screen.timed(record, law)
    yield f"+ drive late by {1e3 * record.late:.2f} ms", screen.in_one(law, record), record.late
    law = screen.tried(record, law, ft.effects.get("stribeck")).settled()
    record = screen.timed(record, law)
    numbers = screen.in_one(law, record)
    yield f"+ stribeck, v_s {numbers['stribeck']['v_s']:.3f} m/s", numbers, record.late


def tribometer(path: Path) -> None:
    """What is named, and held-out errors in N."""
    table = read_table(path, COLUMNS)
    run = ft.Run.from_arrays(table.t, table.x, friction=table.friction, sigma=1e-7, normal_load=5.0)
    print("tribometer, coulomb + viscous", flush=True)
    print_diagnosis(ft.fit("coulomb,viscous", [run]))


def print_diagnosis(fitted_law: ft.Fit) -> None:
    """The diagnosis in lines, with its processor time."""
    clock = time.process_time()
    found = ft.diagnose(fitted_law)
    print(f"  {found.verdict}: {', '.join(found.missing)}  ({time.process_time() - clock:.1f} s)")
    for c in found.candidates[:4]:
        said = c.summary()
        held = [said.get(f"heldout_rms_{w}_{c.unit}") for w in ("before", "after")]
        print(f"    {c.effect}: p {c.p:.3g}, delta BIC {c.delta_bic:.4g}, held out {held} {c.unit}")


if __name__ == "__main__":
    main()
