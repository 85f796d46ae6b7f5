"""Check the conventions of the code: names, import circles, and packages entered by their interface."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "frictrack").rglob("*.py"))
}
PACKAGES = {name for name, path in MODULES.items() if path.name == "__init__.py"}
INTERFACES = PACKAGES | {"frictrack.effects.models", "frictrack.simulate.scene"}
# Rooms of modules that have nothing in common but their layer; each is imported by its name.
OPEN = {
    *("frictrack", "frictrack.base", "frictrack.fit", "frictrack.fit.separable", "frictrack.measure"),
    *("frictrack.results", "frictrack.settings"),
}


@cache
def trees() -> dict[str, ast.Module]:
    """The syntax tree of every module, parsed once for all tests."""
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


# Words of a former vocabulary; docs/glossary.md says what to write instead.
RETIRED = {
    *("told", "beside", "along", "here", "crew", "wander", "plainer", "sure", "turning", "desk", "door", "sought"),
    *("alike", "witness", "witnesses", "ledger"),
}
# Constants that name neither their meaning nor their unit.
VAGUE = {
    *("MOST", "LEAST", "SURE", "ALIKE", "FEW", "MANY", "HARD", "SMALL", "LARGE", "ENOUGH", "NEAR", "FAR", "OFTEN"),
    *("FEWEST", "LONGEST", "SHORTEST", "CLEAR", "CLOSE", "APART", "AGAIN", "STILL", "SEEN", "LIKELY", "SAME", "OTHER"),
    *(
        "WORTH",
        "ONLY",
        "CERTAIN",
        "SLOW",
        "FAST",
        "TINY",
        "WIDE",
        "NARROW",
        "LOOSE",
        "STRONG",
        "WEAK",
        "PLAIN",
        "ALONE",
    ),
}


@cache
def words_of(name: str) -> frozenset[str]:
    """The words of an identifier, in lower case."""
    return frozenset(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().split("_"))


def names_of(tree: ast.Module) -> set[str]:
    """Every class, function and argument that a module defines."""
    defined = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    return {n.arg if isinstance(n, ast.arg) else n.name for n in ast.walk(tree) if isinstance(n, defined | ast.arg)}


@cache
def names_by_word() -> dict[str, list[str]]:
    """The names of all modules and of what they define, by each word in them."""
    found: dict[str, list[str]] = {}
    named = [(name.rpartition(".")[2], name) for name in MODULES]
    for name, place in [*named, *((n, f"{module}: {n}") for module, tree in trees().items() for n in names_of(tree))]:
        for word in words_of(name):
            found.setdefault(word, []).append(place)
    return found


def constants_of(tree: ast.Module) -> list[str]:
    """Every constant that a module defines."""
    assigned = [n for n in tree.body if isinstance(n, ast.Assign | ast.AnnAssign)]
    targets = [t for n in assigned for t in (n.targets if isinstance(n, ast.Assign) else [n.target])]
    return [t.id for t in targets if isinstance(t, ast.Name) and t.id.isupper()]


def imports_of(tree: ast.Module) -> list[tuple[str, str]]:
    """Every `from frictrack... import name` of a module, those inside functions and for type checking among them."""
    found = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and (n.module or "").startswith("frictrack")]
    return [(n.module or "", alias.name) for n in found for alias in n.names]


def target_of(module: str, name: str) -> str:
    """The module that an import executes last."""
    return f"{module}.{name}" if f"{module}.{name}" in MODULES else module


def test_a_public_class_name_has_one_meaning():
    names = Counter(
        node.name
        for tree in trees().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []


@pytest.mark.parametrize("word", sorted(RETIRED))
def test_no_name_holds_a_retired_word(word):
    assert names_by_word().get(word, []) == []


def test_constants_carry_a_meaning():
    assert [
        f"{module}: {c}" for module, tree in trees().items() for c in constants_of(tree) if c.strip("_") in VAGUE
    ] == []


def test_no_module_imports_itself_by_way_of_others():
    graph = {name: {target_of(*i) for i in imports_of(tree)} - {name} for name, tree in trees().items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as e:
        pytest.fail(" -> ".join(e.args[1]))


def test_rooms_are_entered_by_their_interface():
    past = []
    for name, tree in trees().items():
        for module, imported in imports_of(tree):
            target = target_of(module, imported)
            package = target.rpartition(".")[0]
            inside = name.split(".")[:2] == package.split(".")[:2]
            if target not in INTERFACES and package not in OPEN and not inside:
                past.append(f"{name}: from {module} import {imported}")
    assert past == []
