"""Many studies at once: on this machine's processors, or on the workers of a Dask cluster.

from frictrack.batch import batch
result = batch(["campaign/"], Path("frictrack_batch"))

A failed run never stops the rest; it is listed with its reason. What was finished and has not changed since is not
done again. Beside ``frictrack_batch.csv`` (and ``.parquet``) stand a page that shows them, ``frictrack_batch.html``,
and the journal by which the next batch knows what is missing, ``frictrack_batch.jsonl``.
"""

from frictrack.batch.driver import batch
from frictrack.batch.scheduler import BatchState
from frictrack.batch.study_search import find_studies

__all__ = ["BatchState", "batch", "find_studies"]
