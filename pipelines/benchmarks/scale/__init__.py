"""Benchmark of scaling: cores, length of a film, number of runs, archives."""
