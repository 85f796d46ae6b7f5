"""Read projects as the video program Tracker does: line by line, after the source of OSP's XMLControlElement.

Written after ``readObject``, ``readProperty``, ``arrayValue`` and ``collectionValue`` of
github.com/OpenSourcePhysics/osp, and ``ImageCoordSystem.updateTransforms``; tags are found by text, not by XML.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np


def read_project(text: str) -> dict[str, Any]:
    """The properties of the object in a file, as nested dictionaries with their class under "class"."""
    lines = iter(text.split("\n"))
    opening = next(line for line in lines if "<object class=" in line)
    return _read_object(lines, opening)


def _attribute(line: str, name: str) -> str:
    found = re.search(rf'{name}="([^"]*)"', line)
    return found[1] if found else ""


def _read_object(lines: Iterator[str], opening: str) -> dict[str, Any]:
    found: dict[str, Any] = {"class": _attribute(opening, "class")}
    if "/>" in opening:
        next(lines)
        return found
    for line in lines:
        if "</object>" in line:
            next(lines, "")  # the closing tag of the property
            return found
        if "<property" in line:
            found[_attribute(line, "name")] = _read_property(lines, line)
    raise AssertionError("the object does not end")


def _read_property(lines: Iterator[str], line: str) -> Any:
    kind = _attribute(line, "type")
    if kind in ("array", "collection"):
        items: list[tuple[str, Any]] = []
        if "/>" in line:
            return []
        line = next(lines)
        while "<property" in line:
            items.append((_attribute(line, "name"), _read_property(lines, line)))
            line = next(lines)
        if kind == "collection":
            return [value for _, value in items]
        indices = [int(name[1 : name.index("]")]) for name, _ in items]
        array = [None] * (indices[-1] + 1)  # the last item gives the length
        for index, (_, value) in zip(indices, items, strict=True):
            array[index] = value
        return array
    if kind == "object":
        return _read_object(lines, next(lines))
    content = line[line.index(">") + 1 : line.index("</property>")]
    if kind == "string":
        marked = re.fullmatch(r"<!\[CDATA\[(.*)\]\]>", content)
        return marked[1] if marked else content
    return {"int": int, "double": float, "boolean": lambda text: text == "true"}[kind](content)


def world_positions(coords: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """Image points (n, 2) in world units, by the inverse of the affine transform of Tracker."""
    data = coords["framedata"][0]
    angle = np.radians(data["angle"])
    cos, sin, sx, sy = np.cos(angle), np.sin(angle), data["xscale"], data["yscale"]
    to_image = np.array([[sx * cos, -sx * sin], [-sy * sin, -sy * cos]])  # setTransform(m00, m10, m01, m11, ...)
    return np.linalg.solve(to_image, (points - [data["xorigin"], data["yorigin"]]).T).T
