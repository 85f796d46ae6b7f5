"""Run a batch on Kubernetes: the Dask operator starts workers, frictrack distributes the studies.

    pip install "frictrack[cluster]" dask-kubernetes s3fs
    helm install --repo https://helm.dask.org -n dask-operator --create-namespace --generate-name \\
        dask-kubernetes-operator
    python pipelines/cluster/kubernetes.py PATH... --image registry.example/frictrack --claim studies --workers 20

IMAGE holds the same version of frictrack as this machine (`FROM python:3.12-slim`, then
`RUN pip install "frictrack[cluster]"`).
CLAIM is a ReadWriteMany volume claim with the studies, mounted at the path under which this machine sees them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dask_kubernetes.operator import KubeCluster, make_cluster_spec

from frictrack.flow.batch import batch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--image", required=True)
    parser.add_argument("--claim", required=True, help="volume claim with the studies")
    parser.add_argument("--mount", default="/studies", help="where it is mounted, on this machine and in the pods")
    parser.add_argument("--workers", type=int, default=10)
    parser.add_argument("--memory", default="2Gi", help="of one worker")
    parser.add_argument("--output", type=Path, default=Path("frictrack_batch"))
    args = parser.parse_args()

    spec = make_cluster_spec(
        name="frictrack",
        image=args.image,
        n_workers=args.workers,
        worker_command="dask worker --nthreads 1",  # a study is one thread of work
        resources={"requests": {"cpu": "1", "memory": args.memory}, "limits": {"memory": args.memory}},
        env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    pod = spec["spec"]["worker"]["spec"]
    pod["volumes"] = [{"name": "studies", "persistentVolumeClaim": {"claimName": args.claim}}]
    pod["containers"][0]["volumeMounts"] = [{"name": "studies", "mountPath": args.mount}]
    with KubeCluster(custom_cluster_spec=spec) as cluster:
        found = batch(args.paths, args.output, scheduler=cluster.scheduler_address)
    print(found["output"])


if __name__ == "__main__":
    main()
