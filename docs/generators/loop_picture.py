"""Draw the picture of the README: `python docs/generators/loop_picture.py`."""

from __future__ import annotations

from pathlib import Path

import frictrack as ft
from frictrack.present import plots

PICTURE = Path(__file__).parents[1] / "_static" / "loop.png"


def main() -> None:
    """Diagnose the sample runs, add what they lack, and draw both models."""
    runs = ft.samples.runs()
    fit = ft.fit("tustin", runs)
    diagnosis = ft.diagnose(fit)
    assert diagnosis.best is not None
    better = ft.fit(fit.model + diagnosis.best.effect, runs)
    plots.verdict(diagnosis, better, title=False).savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    main()
