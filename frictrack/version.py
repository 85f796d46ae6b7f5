"""Which frictrack this is; results, journals and workers of other ones are told by it."""

from importlib.metadata import version

__version__ = version("frictrack")
