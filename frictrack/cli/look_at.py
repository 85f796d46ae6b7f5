"""Say what to look at when a command has ended: the file or the column, what to see in it, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from frictrack.base.number_format import describe_change

MIN_CHI2_MISFIT = 1.2  # reduced; below, what is left has the size of the noise, whether or not it is noise
_TEXTS = {
    "track": "{output}/<run>_track.png: the frame must lie on the slider in every picture. Then: frictrack run {study}",
    "motion": "v max: it must be a speed that you expect; otherwise scale or fps is wrong. "
    "frictrack export {study} writes the curves as tables",
    "friction": "mean F N: divided by the normal load it is the friction coefficient; free from and free to must "
    "enclose the slide alone. Then: frictrack fit {study}",
    "compare": "held out: the best model has the smallest; a smaller error of the fit alone proves nothing",
    "plan": "the first rows of the table; plan.html shows which pairs of effects each run separates",
    "report": "the first screen of the page: the verdict, the misfit before and after, and what to do next",
    "export": "the files, opened by {opened_by}",
    "crate": "what is not included or missing, above. Then: frictrack reproduce {crate}, at best on another computer",
    "prior": "the deviations: they must be what you believe of the other set-up. There: prior = the file, in [study]",
    "batch": "the page: failures first, then verdicts and trends; frictrack_batch.csv has one row per run",
    "demo": "the first screen of the report; frictrack_demo/study.toml is a study file to copy from",
    "render": "the films; truth.json holds the true motion and forces, which study.toml does not tell",
}


def look_at(command: str, **places: Any) -> str:
    """Return what to look at after a command."""
    typed = {name: shlex.quote(str(places[name])) for name in ("study", "crate") if name in places}
    return _TEXTS[command].format(**places | typed)


def after_fit(fit: Mapping[str, Any], study: Any) -> str:
    """Return what a fit leaves, and what to do next."""
    chi2 = fit.get("errors", {}).get("reduced_chi2")
    if chi2 is None:  # one fit per group
        return f"the parameters by group. frictrack compare {shlex.quote(str(study))} compares models"
    more = f"frictrack diagnose {shlex.quote(str(study))} names what is missing, if anything is"
    if chi2 > MIN_CHI2_MISFIT:
        return f"the model misses the data by {chi2**0.5:.3g} times their noise (square root of chi-squared). {more}"
    return f"what the model leaves is as large as the noise of the data. {more}"


def after_edit(result: Mapping[str, Any], study: Any) -> str:
    """Return what an added or removed effect makes of the held-out error."""
    from frictrack.results.error_rows import held_out_error  # noqa: PLC0415 - `--help` does without it

    (before, _), (after, unit) = (held_out_error(result[key]) for key in ("error_before", "error_after"))
    change = describe_change(before, after, unit)
    study = shlex.quote(str(study))
    return f"the held-out error {change}. frictrack diagnose {study} names what is missing, if anything is"


def after_diagnosis(diagnosis: Mapping[str, Any], study: Any) -> str:
    """Return what to look at after a diagnosis; it depends on the verdict."""
    return f"the verdict above. {_next_step(diagnosis, study)}"


def after_run(diagnosis: Mapping[str, Any], study: Any) -> str:
    """Return what to look at after the whole analysis; it depends on the verdict."""
    return f"the first screen of the report; --details prints more here. {_next_step(diagnosis, study)}"


def _next_step(diagnosis: Mapping[str, Any], study: Any) -> str:
    study = shlex.quote(str(study))
    if named := [*diagnosis["missing"], *diagnosis.get("leads", [])]:
        return f"Then: frictrack add {study} {named[0]} shows by how much the error falls"
    return f"Then: frictrack plan {study} lists which runs would tell more"
