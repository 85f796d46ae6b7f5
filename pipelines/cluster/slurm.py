"""Run a batch on a Slurm cluster: dask-jobqueue requests workers, frictrack distributes the studies.

    pip install "frictrack[cluster]" dask-jobqueue
    python pipelines/cluster/slurm.py PATH... --queue normal --jobs 20 [--show]

The studies must lie on a file system that the nodes share, or their recordings at addresses (`video = "s3://..."`).
The same holds for PBS, SGE, LSF and HTCondor: `PBSCluster`, `SGECluster`, `LSFCluster`, `HTCondorCluster`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dask_jobqueue import SLURMCluster

from frictrack.flow.batch import batch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--queue", required=True)
    parser.add_argument("--jobs", type=int, default=10)
    parser.add_argument("--cores", type=int, default=8, help="of one job; as many studies at once")
    parser.add_argument("--memory", default="16GB", help="of one job")
    parser.add_argument("--walltime", default="04:00:00")
    parser.add_argument("--output", type=Path, default=Path("frictrack_batch"))
    parser.add_argument("--show", action="store_true", help="print the script of one job and stop")
    args = parser.parse_args()

    cluster = SLURMCluster(
        queue=args.queue,
        cores=args.cores,
        processes=args.cores,  # one process per core: a study is one thread of work
        memory=args.memory,
        walltime=args.walltime,
        job_script_prologue=["export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1"],
    )
    with cluster:
        if args.show:
            print(cluster.job_script())
            return
        cluster.scale(jobs=args.jobs)
        cluster.wait_for_workers(1)  # the others join as Slurm starts them
        found = batch(args.paths, args.output, scheduler=cluster.scheduler_address)
    print(found["output"])


if __name__ == "__main__":
    main()
