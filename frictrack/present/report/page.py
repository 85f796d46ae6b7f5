"""Write the pages of a study, of a batch and of a plan, each with all its figures; print a page to PDF."""

from __future__ import annotations

import base64
import os
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from frictrack.base import glossary
from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write, replace_text
from frictrack.present import plots
from frictrack.present.report import tables, texts
from frictrack.present.report.tables import SvgEmbedder, explain_words, now, page_template
from frictrack.results import ModelResults, Results, RunResults, candidates, verdicts

MODULES = {  # whose functions the template calls
    module.__name__.rpartition(".")[2]: module for module in (glossary, plots, tables, texts, candidates, verdicts)
}
MAX_FILMS = 4  # films of which the first frame is shown


def write(results: Results, path: Path, key: str = "") -> Path:
    """Write the report of a study as HTML, completely or not at all.

    Parameters
    ----------
    results : Results
        The study.
    path : Path
        File to write.
    key : str
        Hash of the inputs of the report, written into its head.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FrictrackError
        If the folder cannot be written.

    """
    return replace_text(path, render(results, key))


def render(results: Results, key: str = "") -> str:
    """Render the report of a study.

    Parameters
    ----------
    results : Results
        The study.
    key : str
        Hash of the inputs of the report, written into its head.

    Returns
    -------
    str
        HTML that contains all figures and refers to no other file.

    """
    figures, embed = dict(plots.study_figures(results)), SvgEmbedder()

    def figure(name: str, **options: Any) -> Markup:
        """A figure of the study; empty if the study has none of this name."""
        return embed(figures[name](**options)) if name in figures else Markup("")

    judged, earlier = _judged_models(results)
    filmed = [run for run in results.runs if run.film is not None and run.track is not None]
    html = page_template("page.html.j2").render(
        **MODULES,
        results=results,
        model=results.current,
        key=key,
        written=now(),
        figure=figure,
        figures=figures,
        verdict=texts.study_verdict(results),
        judged=judged,
        earlier=earlier,
        failed=plots.failed_model(results),
        headline=lambda model: verdicts.describe_verdict(model.diagnosis, plots.plain_name(model.name)),
        filmed=filmed,
        films=[_first_frame(run, wide=len(filmed) == 1) for run in filmed[:MAX_FILMS]],
        budgets={run.name: run.budget for run in results.runs if run.budget},
        with_force=[run for run in results.runs if run.friction is not None and np.any(run.friction.free)],
        of_points=any(run.is_of_points for run in results.runs),
    )
    return explain_words(html)


def _judged_models(results: Results) -> tuple[list[ModelResults], list[ModelResults]]:
    """The models that the report judges: rejected ones or the last one diagnosed; and earlier ones."""
    diagnosed = [m for m in results.models if m.diagnosis is not None]
    rejected = [m for m in diagnosed if plots.is_rejected(m.diagnosis)] or diagnosed[-1:]
    shown = plots.failed_model(results)
    judged = [m for m in rejected if m is shown or m.current] or rejected
    return judged, [m for m in rejected if m not in judged]


def _first_frame(run: RunResults, *, wide: bool) -> Markup:
    data = base64.b64encode(plots.png(plots.film(run, wide=wide), dpi=110 if wide else 200)).decode()
    return Markup('<img alt="first frame of {} with the track" src="data:image/png;base64,{}">').format(run.name, data)


BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
)
OPTIONS = ("--headless", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
           "--disable-sync", "--no-first-run", "--no-pdf-header-footer")  # fmt: skip
MAX_PRINT_SECONDS = 120.0  # a browser usually takes two seconds


def print_pdf(page: Path) -> Path:
    """Print an HTML page to a PDF file of the same name, completely or not at all.

    Parameters
    ----------
    page : Path
        The HTML file.

    Returns
    -------
    Path
        The PDF file.

    Raises
    ------
    FrictrackError
        If no Chromium, Chrome or Edge is installed, or if it fails.

    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise FrictrackError(
            f"expected Chromium, Chrome or Edge on this machine to print a PDF but found none; open {page} in any "
            "browser and print it from there"
        )
    target = page.with_suffix(".pdf")
    with atomic_write(target) as part, tempfile.TemporaryDirectory() as profile:
        command = [browser, *OPTIONS, f"--user-data-dir={profile}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # Chromium has no sandbox for root; the page is our own
        command += [f"--print-to-pdf={part}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=MAX_PRINT_SECONDS, check=False)
        except subprocess.TimeoutExpired as e:
            raise FrictrackError(f"{browser} did not print {page.name} within {MAX_PRINT_SECONDS:g} s") from e
        if done.returncode or not part.exists() or part.stat().st_size == 0:
            reason = (done.stderr.decode(errors="replace").strip().splitlines() or ["it gave no reason"])[-1]
            raise FrictrackError(f"{browser} could not print {page.name}: {reason}")
    return target


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
    separation = SvgEmbedder()(plots.pair_separation(plan))
    return replace_text(path, page_template("plan.html.j2").render(plan=plan, written=now(), separation=separation))
