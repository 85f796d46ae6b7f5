"""Import names when they are first used (PEP 562), so that light commands start quickly."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def imported(path: str) -> Any:
    """Import one name of a module, "package.module:name".

    Records offer methods that compute with packages of higher layers, such as `Run.from_arrays`. They import them here
    when they are called, so that no layer depends on a higher one.

    Parameters
    ----------
    path
        Module and name.

    Examples
    --------
    >>> imported("math:hypot")(3, 4)
    5.0

    """
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def module_of(exports: Mapping[str, str]) -> dict[str, str]:
    """Return the module of every name that a package exports.

    Parameters
    ----------
    exports
        Names, separated by spaces, by their module.

    Examples
    --------
    >>> module_of({"motion": "low_pass differentiate"})
    {'low_pass': 'motion', 'differentiate': 'motion'}

    """
    return {name: module for module, names in exports.items() for name in names.split()}


def lazy_names(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that imports its names on first use.

    Parameters
    ----------
    package
        Name of the package, as ``__name__`` has it.
    modules
        The module of the package that defines a name, by name. No name may be that of a module.

    """

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{modules[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return find
