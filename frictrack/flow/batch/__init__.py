"""Run many studies side by side: on the processors of this machine, or on the workers of a Dask cluster.

    from frictrack.flow.batch import batch
    result = batch(["campaign/"], Path("frictrack_batch"))

A run that fails never stops the others; it is listed with its reason. A study that was finished before and has not
changed since is not computed again.

    frictrack_batch.csv, .parquet    one row per run
    frictrack_batch.html             the page
    .frictrack/frictrack_batch.jsonl the journal of finished studies
"""

from frictrack.flow.batch.driver import batch, find_studies
from frictrack.flow.batch.tasks import BatchState

__all__ = ["BatchState", "batch", "find_studies"]
