"""Errors, units, numbers as text, distributions, files, processes: what every room uses; none knows a record."""
