"""How a diagnosis fares on measurements made by others.

    python pipelines/benchmarks/diagnosis_real.py --emps FOLDER --tribometer FILE [--seconds 24.8]

EMPS (Janot, Gautier, Brunot 2019): the symmetric law is diagnosed, the first effect that is named is added, and the
relative force error in the authors' measure (their filter, trim and decimation; norm of the drive) stands before and
after. Tribometer (FrictionModels.jl): a law without memory is diagnosed; held-out errors in N.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from identification.emps import PUBLISHED, Record, records
from identification.machine_fit import filmed, fitted, scored

import frictrack as ft
from frictrack.records import Displacement, Run
from frictrack.study import read_table

COLUMNS = {"t": "Time [s]", "x": "Position [mm]", "friction": "-Friction [uN]"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--emps", type=Path, help="folder of DATA_EMPS.mat")
    parser.add_argument("--tribometer", type=Path, help="test_data_2.txt, or a part of it")
    parser.add_argument("--seconds", type=float, default=24.8, help="of the EMPS record that is diagnosed")
    args = parser.parse_args()
    if args.emps:
        emps(records(args.emps)["train"], args.seconds)
    if args.tribometer:
        tribometer(args.tribometer)


def emps(record: Record, seconds: float) -> None:
    """What is named, and the force error before and after."""
    whole = filmed(record)
    part = filmed(Record(record.q[: int(seconds * record.rate)], record.drive[: int(seconds * record.rate)]))
    before = fitted(whole, {"coulomb": {}, "viscous": {}})
    print(f"EMPS, coulomb + viscous: {scored(before, record):.3f} %", flush=True)
    for law, printed in PUBLISHED.items():
        print(f"  published, {law}: {printed['train']:.3f} %")
    uneven = fitted(whole, {"coulomb": {}, "viscous": {}, "asymmetry": {}})
    print(f"  with asymmetry: {scored(uneven, record):.3f} %", flush=True)
    squared = ft.effects.formula("uneven", "F * v^2 + D", units={"F": "N s^2/m^2", "D": "N"})
    other = ft.fit(before.model + squared, [whole])
    print(
        f"  with v^2 whichever way instead of |v|: {scored(other, record):.3f} %: the form in v is not settled",
        flush=True,
    )
    told(ft.fit("coulomb,viscous", [part]))


def tribometer(path: Path) -> None:
    """What is named, and held-out errors in N."""
    table = read_table(path, COLUMNS)
    nan = np.full(len(table.t), np.nan)
    seen = Displacement(table.t, table.x, nan, nan, np.full(len(nan), 1e-7), nan, np.ones(len(nan), bool))
    motion = ft.differentiate(ft.low_pass(seen, method="kalman"))
    print("tribometer, coulomb + viscous", flush=True)
    told(ft.fit("coulomb,viscous", [Run(seen, motion, friction_N=table.friction, normal_load=5.0)]))


def told(fitted_law: ft.Fit) -> None:
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
