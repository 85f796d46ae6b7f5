"""Measure a batch of raw films on a Dask cluster of this machine, with one worker and with two.

    python pipelines/benchmarks/cluster [--GB 2] [--workers 1,2] [--folder DISK] [--json FILE]

Films of 262 MB (Photron, 8 bit) are written, one study each. Every batch begins without results, without kept hashes
and without the films in memory. Printed for each number of workers: wall and processor seconds, bytes of film per
second, and the speed-up against the first number; and whether the tables are the same. What is measured is put into the
file (default: results.json beside this one). A quiet machine, and as many processors as workers.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import psutil  # noqa: E402
from distributed import Client, LocalCluster  # noqa: E402
from machine import described  # noqa: E402

from cluster.films import write_films  # noqa: E402 - found only now
from frictrack.base.workers import processors  # noqa: E402
from frictrack.flow.batch import batch  # noqa: E402

RESULTS = Path(__file__).with_name("results.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--GB", type=float, default=2.0, help="all films together")
    parser.add_argument("--workers", default="1,2", help="numbers of workers, with commas")
    parser.add_argument("--folder", type=Path, help="where the films are written for the time of the measurement")
    parser.add_argument("--json", type=Path, default=RESULTS, help="file for all figures")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        films = write_films(folder, 1e9 * args.GB)
        size = sum(film.stat().st_size for film in films)
        print(f"{len(films)} films, {size / 1e9:.2f} GB", flush=True)
        rows: list[dict[str, Any]] = []
        for workers in map(int, args.workers.split(",")):
            rows.append(_measure(folder, films, workers))
            _compare(rows[-1], rows[0], size)
            print(_described(rows[-1]), flush=True)
        tables = [(folder / f"on_{row['workers']}.csv").read_bytes() for row in rows]
    same = all(table == tables[0] for table in tables)
    print(f"tables: {'the same' if same else 'OTHER'}")
    machine = described("numpy", "distributed") | {"cores": processors()}
    found = {"machine": machine, "films": len(films), "bytes": size, "same": same, "on": rows}
    args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(f"results: {args.json}")


def _measure(folder: Path, films: list[Path], workers: int) -> dict[str, Any]:
    """Run the batch on a new cluster; wall seconds, and processor seconds of every worker."""
    for results in folder.glob("*/study_results"):
        shutil.rmtree(results)
    for film in films:
        _drop_from_memory(film)
    with tempfile.TemporaryDirectory(dir=folder) as kept:
        os.environ["FRICTRACK_CACHE"] = kept
        with (
            LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            client.run(_load)
            before, start = client.run(_processor_time), time.perf_counter()
            found = batch([str(folder)], folder / f"on_{workers}", scheduler=cluster.scheduler_address)
            took, after = time.perf_counter() - start, client.run(_processor_time)
    assert not found["failed"], found["failed"]
    return {"workers": workers, "wall_s": took, "cpu_s": [after[one] - before[one] for one in before]}


def _compare(row: dict[str, Any], first: dict[str, Any], size: int) -> None:
    """Add the rates; by processor time, a batch takes as long as its busiest worker."""
    ratio = row["workers"] / first["workers"]
    row["bytes_per_s"] = size / row["wall_s"]
    row["speed_up"] = first["wall_s"] / row["wall_s"]
    row["efficiency"] = row["speed_up"] / ratio
    row["efficiency_cpu"] = max(first["cpu_s"]) / max(row["cpu_s"]) / ratio


def _described(row: dict[str, Any]) -> str:
    return (
        f"{row['workers']} workers: {row['wall_s']:.1f} s, processor {sum(row['cpu_s']):.1f} s, "
        f"{row['bytes_per_s'] / 1e6:.1f} MB/s; speed-up {row['speed_up']:.2f}, {row['efficiency']:.3f} of the ideal "
        f"(by processor time {row['efficiency_cpu']:.3f})"
    )


def _drop_from_memory(path: Path) -> None:
    """Make the system read a file from the disk again."""
    if hasattr(os, "posix_fadvise"):  # not on Windows
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _load() -> None:
    """Import in a worker what a batch needs."""
    import frictrack.flow.batch  # noqa: PLC0415
    import frictrack.recording  # noqa: F401, PLC0415


def _processor_time() -> float:
    """Processor seconds of a worker and of its processes that have ended."""
    times = psutil.Process().cpu_times()
    return float(times.user + times.system + times.children_user + times.children_system)


if __name__ == "__main__":
    main()
