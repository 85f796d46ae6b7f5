"""Draw the figures of the Python interface on the sample runs, for the pages of `frictrack.present.plots`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from json_reference import program_hash
from page_text import small_png, write_page

PICTURE_DPI = 90
SETUP = """import frictrack as ft
from frictrack.present import plots

runs = ft.samples.runs()
fit = ft.fit("tustin", runs)
"""
DIAGNOSIS = "diagnosis = ft.diagnose(fit)\n"
PAPERS = 'papers = ft.fit("tustin", runs, domain="force")\n'
BETTER = 'better = ft.fit(["coulomb", "stribeck", "viscous", "patch"], runs)\n'
STYLES = "from frictrack.present.plots.style import run_styles\n"
FILTERED = "filtered = ft.low_pass(runs[2].displacement)\n"
# By function: what comes after the setup, and the call.
CALLS: dict[str, tuple[str, str]] = {
    "motion": ("", "plots.motion(runs[2])"),
    "motions": ("", "plots.motions(runs)"),
    "friction": ("", "plots.friction(runs)"),
    "table": ("", "plots.table(runs[2].motion)"),
    "cutoff": (
        FILTERED,
        'plots.cutoff("to_a_stop", ft.cutoff_tradeoff(runs[2].displacement, filtered, runs[2].motion))',
    ),
    "filters": ("", "plots.filters(runs[2])"),
    "budget": (FILTERED, 'plots.budget("to_a_stop", ft.budget(runs[2], filtered).summary())'),
    "fit": ("", "plots.fit(fit, runs)"),
    "law": ("", "plots.law(fit, runs)"),
    "modelled": ("", "plots.modelled(fit, runs)"),
    "failing": (BETTER, "plots.failing(fit, runs, ft.compare(fit).fails_at, better)"),
    "routes": (PAPERS, "plots.routes(fit, papers, runs[2])"),
    "history": (BETTER, "plots.history([fit, better])"),
    "candidates": (DIAGNOSIS, "plots.candidates(diagnosis)"),
    "missing_force": (
        DIAGNOSIS + STYLES,
        "plots.missing_force(diagnosis.figures, diagnosis.fails_at, run_styles(runs))",
    ),
    "limits": (DIAGNOSIS, "plots.limits(diagnosis)"),
    "verdict": (DIAGNOSIS + BETTER, "plots.verdict(diagnosis, better)"),
}


def draw_pictures(folder: Path) -> None:
    """Draw all pictures into a folder, unless the program is the one that drew them.

    Parameters
    ----------
    folder
        Folder of the pictures.

    """
    mark = f"{program_hash()} {json.dumps(CALLS)}"
    kept = folder / "made.txt"
    if kept.exists() and kept.read_text() == mark:
        return
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in drawn().items():
        (folder / f"{name}.png").write_bytes(content)
    write_page(kept, mark)


def drawn() -> dict[str, bytes]:
    """Run the code of all pages, and return the pictures."""
    names: dict[str, Any] = {}
    done: set[str] = set()
    for before, _ in [(SETUP, ""), *CALLS.values()]:
        for line in before.splitlines():
            if line not in done:
                exec(line, names)
                done.add(line)
    return {name: small_png(eval(call, names), PICTURE_DPI) for name, (_, call) in CALLS.items()}


def example_of(name: str) -> str:
    """Return the example of a figure as Markdown: its code and the picture; nothing where none is drawn.

    Parameters
    ----------
    name
        Name of the function in `frictrack.present.plots`.

    """
    if name not in CALLS:
        return ""
    before, call = CALLS[name]
    picture = f"```{{image}} pictures/{name}.png\n:alt: The figure that plots.{name} draws for the sample runs\n```\n"
    return f"\n## Example\n\n```python\n{SETUP}{before}{call}\n```\n\n{picture}"
