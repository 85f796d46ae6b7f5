"""Errors, units, numbers as text, distributions, files, processes: what every room uses; none knows a record."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from typing import Any

__version__ = version("frictrack")  # by which results, journals and workers of other versions are recognised


def imported(path: str) -> Any:
    """Import one name of a module, "package.module:name".

    Records offer methods that compute with packages of higher layers, such as `Run.from_arrays`. They import them here
    when they are called, so that no layer depends on a higher one.

    Examples
    --------
    >>> imported("math:hypot")(3, 4)
    5.0

    """
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def imports_of(package: str) -> dict[str, str]:
    """Return the names that a package imports for type checkers, each with the module that it comes from.

    So every name is written once. The block ``if TYPE_CHECKING:`` is the first one of the package.
    """
    loader: Any = sys.modules[package].__loader__  # which reads packages in archives, too
    block = next(node for node in ast.parse(loader.get_source(package)).body if isinstance(node, ast.If))
    lines = (node for node in block.body if isinstance(node, ast.ImportFrom))
    return {alias.name: str(line.module) for line in lines for alias in line.names}


def lazy_names(package: str) -> tuple[Callable[[str], Any], list[str]]:
    """Return the `__getattr__` and the `__all__` of a package that imports on first use what `imports_of` returns.

    A name that is imported from the package itself is a module in it.
    """
    modules = imports_of(package)

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        own = modules[name] == package
        value = import_module(f"{package}.{name}") if own else getattr(import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return find, sorted(modules)
