"""Benchmark of a batch of raw films over the workers of a Dask cluster."""
