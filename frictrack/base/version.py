"""Define the version of frictrack; results, journals and workers of other versions are recognised by it."""

from importlib.metadata import version

__version__ = version("frictrack")
