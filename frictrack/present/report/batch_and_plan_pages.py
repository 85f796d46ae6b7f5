"""Write the pages of a batch of studies and of a plan of runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from frictrack.base.files import replace_text
from frictrack.present import plots
from frictrack.present.report.markup import SvgEmbedder, now, page_template

MAX_STUDIES_SHOWN = 1000  # in the table of the page; the files hold all
MAX_PANELS = 12  # trends drawn, the most significant first
ORDER = ("complete", "undetermined", "missing", "ambiguous", "unexplained")


def write_campaign(
    result: Mapping[str, Any], trends: Sequence[Mapping[str, Any]], links: Mapping[str, str], path: Path
) -> Path:
    """Write the page of a batch as HTML, completely or not at all.

    Parameters
    ----------
    result : mapping
        The JSON of `frictrack batch`.
    trends : sequence of mappings
        Quantities over the series, as `plots.trends` draws them.
    links : mapping
        Address of the report of each study, relative to the page.
    path : Path
        File to write.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    clearest = sorted(trends, key=lambda one: one["p"])[:MAX_PANELS]
    finished = [one for one in result["studies"] if not one["reason"]]
    html = page_template("campaign.html.j2").render(
        result=result,
        links=links,
        finished=len(finished),
        trends=sorted(trends, key=lambda one: one["p"]),
        series=SvgEmbedder()(plots.trends(clearest)) if clearest else Markup(""),
        left_out=len(trends) - len(clearest),
        order=[*ORDER, *(name for name in result["verdicts"] if name not in ORDER)],
        missing=Counter(name for one in finished for name in one["missing"]).most_common(),
        max_studies=MAX_STUDIES_SHOWN,
        written=now(),
    )
    return replace_text(path, html)


def write_plan(plan: Mapping[str, Any], path: Path) -> Path:
    """Write the page of a plan as HTML, completely or not at all.

    Parameters
    ----------
    plan : mapping
        The JSON of `frictrack plan`.
    path : Path
        File to write.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    draw = SvgEmbedder()
    html = page_template("plan.html.j2").render(
        plan=plan,
        written=now(),
        remaining=draw(plots.remaining_pairs(plan)),
        separation=draw(plots.pair_separation(plan)),
    )
    return replace_text(path, html)
