"""Define the colours, line styles and matplotlib settings that all figures share.

The palette is safe for colour-blind readers. Where two things meet in one panel, they also differ in line style,
marker or hatching, so that figures can be read in grey.

References
----------
M. Okabe, K. Ito (2008): Color Universal Design, https://jfly.uni-koeln.de/color/.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
MEASURED_COLOUR, MODEL_COLOUR, NOISE_COLOUR, FREE_COLOUR = "#333333", VERMILION, "#CFE3F1", "#EAF3EA"
REPAIRED_COLOUR = PURPLE  # ticks of frames that the user repaired
RUN_STYLES: list[dict[str, Any]] = [
    {"color": color, "linestyle": dash}
    for dash in ("-", (0, (5, 1.5)), (0, (1, 1)))
    for color in (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)
]  # one per run, then again dashed and dotted
DOT_STYLE: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 2.5}

RC_PARAMS: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.linewidth": 0.8,
    "axes.labelcolor": "#222222",
    "axes.axisbelow": True,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "lines.linewidth": 1.5,
    "hatch.linewidth": 0.6,
    "hatch.color": "#777777",
    "figure.titlesize": 12,
    "figure.titleweight": "bold",
    "svg.fonttype": "none",
    "svg.hashsalt": "frictrack",
    "path.simplify_threshold": 0.2,
}


def run_styles(runs: Sequence[Any]) -> dict[str, dict[str, Any]]:
    """Assign a colour and a line style to each run of a study, the same in all figures.

    Parameters
    ----------
    runs : sequence
        Objects with a `name`, in the order of the study.

    Returns
    -------
    dict
        Keyword arguments of `Axes.plot` by the name of the run.

    """
    return {run.name: RUN_STYLES[k % len(RUN_STYLES)] for k, run in enumerate(runs)}
