"""Write Markdown pages: tables, escapes, small pictures, and files that change only when their text does."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from frictrack.present.plots import png

MAX_COLOURS = 128  # of a picture


def write_page(path: Path, text: str) -> None:
    """Write a page if its text has changed, so that Sphinx reads again only what is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def keep_only(folder: Path, names: Iterable[str]) -> None:
    """Remove the pages of a folder that have other names: those of functions or effects that are gone."""
    kept = {f"{name}.md" for name in names}
    for path in folder.glob("*.md"):
        if path.name not in kept:
            path.unlink()


def small_png(figure: Figure, dpi: float) -> bytes:
    """Convert a figure to a PNG of few colours, a third of the size."""
    picture = Image.open(io.BytesIO(png(figure, dpi))).convert("RGB").quantize(MAX_COLOURS, Image.Quantize.FASTOCTREE)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    r"""Return a Markdown table; a bar in a cell is escaped.

    Examples
    --------
    >>> print(table(["key", "type"], [["fps", "number | text"]]))
    | key | type |
    |---|---|
    | fps | number \\| text |
    <BLANKLINE>

    """
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def code(text: str) -> str:
    """Return inline code; nothing for an empty text."""
    return f"`{text}`" if text else ""


def plain(text: str) -> str:
    r"""Escape what Markdown would read as emphasis, a heading or a tag.

    Examples
    --------
    >>> plain("F_s < F_c * 2")
    'F\\_s &lt; F\\_c \\* 2'

    """
    for sign in ("\\", "*", "_", "`", "[", "]", "|"):
        text = text.replace(sign, f"\\{sign}")
    return text.replace("<", "&lt;").replace(">", "&gt;")


def prose(text: str) -> str:
    r"""Escape a text, code between backticks excepted.

    Examples
    --------
    >>> prose("a key such as `F_s` of [study]")
    'a key such as `F_s` of \\[study\\]'

    """
    parts = re.split(r"(`+)(.+?)\1", text)
    out = [plain(parts[0])]
    for ticks, inside, after in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
        out += [f"{ticks}{inside}{ticks}", plain(after)]
    return "".join(out)


def sentence(text: str) -> str:
    """Return a text as a sentence: a capital letter first, a full stop last."""
    return f"{text[:1].upper()}{text[1:]}".rstrip(".") + "."
