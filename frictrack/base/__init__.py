"""Errors, units, numbers as text, distributions, files, processes: what every room uses; none knows a record."""

from importlib.metadata import version

__version__ = version("frictrack")  # by which results, journals and workers of other versions are recognised
