"""Define the commands on one study. Each updates what it depends on, prints the result and where the files are."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from frictrack import flow
from frictrack.base.errors import UsageError
from frictrack.cli.common import (
    STUDY_HERE,
    Effect,
    EffectOrFormula,
    FilmWorkers,
    Json,
    Search,
    Seed,
    Study,
    after_diagnosis,
    after_edit,
    after_fit,
    command,
    look_at,
    open_session,
    print_first,
    print_result,
    progress_bars,
)
from frictrack.present.export import FORMATS, export_results

PRIOR, CRATE = "prior", "crate"  # formats that take more than the results: the fit, and all files of the study
if TYPE_CHECKING:
    from frictrack.flow import Session

    FormatName = str
else:
    FormatName = Literal[*FORMATS, PRIOR, CRATE]


@command()
def run(  # noqa: PLR0913, PLR0917 - one argument per option
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="STUDY | RECORDING...",
            help="a study file (default: study.toml); or films, tables, and folders of them",
            show_default=False,
        ),
    ] = None,
    model: str | None = None,
    mass: str | None = None,
    scale: str | None = None,
    fps: float | None = None,
    workers: FilmWorkers = 1,
    seed: Seed = 0,
    details: bool = False,
    as_json: Json = False,
) -> None:
    """Measure, fit, compare, diagnose and write the report.

    Reads a study file and its recordings. With recordings instead of a study file, it first writes study.toml in the
    current folder. Writes the results of every run (.h5), study.h5 and report.html into the folder of the results.

    Options
    -------
    model : first model (default: tustin); only with recordings
    mass : mass of the slider, as in "0.35kg"; only with recordings
    scale : size of a pixel, as in "0.5mm/px"; only with recordings
    fps : frame rate while filming, 1/s; only with recordings
    details : print also all candidates, where the model fails and what to film next

    Examples
    --------
    frictrack run study.toml
    frictrack run a.avi b.avi --mass 0.35kg --scale 0.5mm/px --fps 4000

    """
    path = _study_of(paths or [Path("study.toml")], {"mass": mass, "fps": fps, "scale": scale, "model": model})
    parts = ["run_verdict", "diagnosis_rest"] if details else ["run_brief"]
    with open_session(path, workers) as session:
        result = session.run(seed, on_verdict=print_first(session, as_json, parts))
    first = "the first screen of the report; --details prints more here."
    page, look = session.study.output / "report.html", after_diagnosis(result["diagnose"], path, first)
    print_result(result, as_json, " ".join(parts), page, look)


def _study_of(paths: list[Path], keys: dict[str, Any]) -> Path:
    """Return the study file; if recordings are given, write one."""
    one = paths[0]
    given = [key for key, value in keys.items() if value is not None]
    if one.suffix == ".toml" or (one / "study.toml").exists():
        if len(paths) > 1:
            raise UsageError("expected one study file; `frictrack batch` runs several")
        if given:
            raise UsageError(f"expected no --{given[0]} together with a study file; set {given[0]} in the file")
        return one
    if one.is_dir() and not given:
        typed = shlex.quote(str(one))
        raise UsageError(f"expected a study.toml in {one}; `frictrack init {typed}` writes one")
    from frictrack.study import is_table  # noqa: PLC0415

    filmed = any(not is_table(path) for path in paths)  # a table may hold the friction itself, which needs no mass
    lacking = [f"--{key}" for key in (("mass", "scale") if filmed else ()) if key not in given]
    if lacking:
        example = "--mass 0.35kg --scale 0.5mm/px --fps 4000"
        raise UsageError(f"expected {' and '.join(lacking)} together with recordings, as in {example}")
    flow.check_entered(keys)
    if read := flow.describe_keys(keys):
        _tell(f"read as: {read}")
    return flow.start_study(Path("study.toml"), paths, keys, _tell).path


def _tell(line: str) -> None:
    """Write a line to stderr."""
    sys.stderr.write(f"{line}\n")


@command()
def init(
    places: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FOLDER | RECORDING...",
            help="a folder with recordings (default: this one); or recordings",
            show_default=False,
        ),
    ] = None,
    mass: str | None = None,
    scale: str | None = None,
    fps: float | None = None,
    as_json: Json = False,
) -> None:
    """Write a commented study file for a folder of recordings, or for some recordings.

    Opens every film and table in the folder, and lists what it found and what it left out, and why. Writes study.toml
    into the folder, with the frame rate and the columns that the files state; study.toml must not exist yet.

    Options
    -------
    mass : mass of the slider, as in "0.35kg"
    scale : size of a pixel, as in "0.5mm/px"
    fps : frame rate while filming, 1/s (default: that of the files)

    Examples
    --------
    frictrack init films
    frictrack init films --mass 350g --scale 0.5mm/px --fps 4000

    """
    keys = {"mass": mass, "scale": scale, "fps": fps}
    flow.check_entered(keys)
    result = flow.propose_study(places or Path(), keys)
    print_result(result, as_json, "init", result["study"])


def _measure(stage: str, study: Path, as_json: bool, workers: int = 1, *, overlay: bool = False) -> None:
    """Bring every run up to "track", "motion" or "friction"."""
    with open_session(study, workers) as session:
        result = session.measure(stage, overlay=overlay)
    output, show = session.study.output, "track" if stage == "track" else "stages"
    print_result(result, as_json, show, output, look_at(stage, study=study, output=output))


@command()
def track(study: Study = STUDY_HERE, overlay: bool = False, workers: FilmWorkers = 1, as_json: Json = False) -> None:
    """Track the slider in every film.

    Reads the films. Writes the tracks into the run's .h5 file, and a contact sheet per film that shows whether the
    tracking went well.

    Options
    -------
    overlay : also write each film with the tracked positions drawn into it

    Examples
    --------
    frictrack track study.toml
    frictrack track study.toml --overlay --workers 4

    """
    _measure("track", study, as_json, workers, overlay=overlay)


@command()
def motion(study: Study = STUDY_HERE, as_json: Json = False) -> None:
    """Compute displacement, velocity and acceleration of every run.

    Reads the films or tables. Writes the motion into the run's .h5 file.

    Examples
    --------
    frictrack motion study.toml
    frictrack motion study.toml --json > motion.json

    """
    _measure("motion", study, as_json)


@command()
def friction(study: Study = STUDY_HERE, as_json: Json = False) -> None:
    """Compute the friction force and the free section of every run.

    Reads the films or tables, and the drive. Writes the force into the run's .h5 file.

    Examples
    --------
    frictrack friction study.toml
    frictrack friction study.toml --json > friction.json

    """
    _measure("friction", study, as_json)


@command()
def fit(  # noqa: PLR0913, PLR0917 - one argument per option
    study: Study = STUDY_HERE,
    model: str | None = None,
    search: Search | None = None,
    over: Literal["all", "nonlinear"] | None = None,
    settings: list[str] | None = None,
    domain: Literal["displacement", "force"] | None = None,
    per: Literal["group"] | None = None,
    seed: int | None = None,
    profile: bool = False,
    bootstrap: int = 0,
    as_json: Json = False,
) -> None:
    """Fit the current model, or make another one current.

    Reads the measured runs; missing stages are computed first. Writes the model into study.h5. Ctrl-C ends a global
    search: the best values so far are kept.

    Options
    -------
    model : a model (tustin, atm1:2), or effects: coulomb,viscous (default: the current)
    search : search method (default: varpro)
    over : parameters of a global search (default: all)
    settings --set NAME=VALUE : setting of a global search: generations=500; may be repeated
    domain : quantity that is fitted (default: displacement; force if friction was measured)
    per : fit one set of parameters per group of runs
    seed : seed of all random numbers (default: 0)
    profile : compute 95 % intervals by profile likelihood
    bootstrap N : compute 95 % intervals by N parametric bootstrap draws

    Examples
    --------
    frictrack fit study.toml --model tustin,texture
    frictrack fit study.toml --search mga --set generations=500

    """
    with open_session(study) as session:
        how: dict[str, Any] = {"search": search, "over": over, "domain": domain, "per": per, "seed": seed}
        how["settings"] = _settings(settings or ())
        result = session.fit(model, profiles=profile, draws=bootstrap, **how)
    print_result(result, as_json, "fit", session.path, after_fit(result, study))


def _settings(pairs: Iterable[str]) -> dict[str, str] | None:
    """Split the texts NAME=VALUE; None without any."""
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not (name.strip() and equals):
            raise UsageError(f'expected --set NAME=VALUE, such as --set generations=500, but got "{pair}"')
        found[name.strip()] = value.strip()
    return found or None


@command()
def compare(study: Study = STUDY_HERE, parameter: str | None = None, as_json: Json = False) -> None:
    """Compare the errors of all models tried, or one parameter between groups of runs.

    Shows where the current model fails. Reads the models in study.h5. Writes the comparison into study.h5.

    Options
    -------
    parameter ADDRESS : compare this parameter between the groups of runs: viscous.F_v

    Examples
    --------
    frictrack compare study.toml
    frictrack compare study.toml --parameter viscous.F_v

    """
    with open_session(study) as session:
        result = session.compare() if parameter is None else session.compare_groups(parameter)
    show = "history fails_at" if parameter is None else "sentences"
    print_result(result, as_json, show, session.path, look_at("compare") if parameter is None else "")


@command()
def diagnose(study: Study = STUDY_HERE, quick: bool = False, seed: Seed = 0, as_json: Json = False) -> None:
    """Find the effect that the current model lacks.

    Prints the verdict as soon as it is known, then where the model fails and what to film next. Reads the runs and the
    current model. Writes the diagnosis into study.h5; the verdict is kept if the command is interrupted afterwards.

    Options
    -------
    quick : end with the verdict; without failure pattern and next experiments

    Examples
    --------
    frictrack diagnose study.toml
    frictrack diagnose study.toml --quick

    """
    parts = ["verdict", "diagnosis_rest"]
    with open_session(study) as session:
        early = None if quick else print_first(session, as_json, parts)
        result = session.diagnose(seed, quick=quick, on_verdict=early)
    print_result(result, as_json, " ".join(parts), session.path, after_diagnosis(result, study))


def _edit(how: Callable[[Session, str], Mapping[str, Any]], study: Path, effect: str | None, as_json: bool) -> None:
    """Add or remove an effect; alone, the first argument is the effect, of the study in this folder."""
    if effect is None:
        study, effect = STUDY_HERE, str(study)
    with open_session(study) as session:
        result = how(session, effect)
    print_result(result, as_json, "edit", session.path, after_edit(result, study))


@command()
def add(study: Study, effect: EffectOrFormula = None, seed: Seed = 0, as_json: Json = False) -> None:
    """Add one effect to the current model and fit again.

    Shows the error before and after. Reads the runs and the current model. Writes the new model into study.h5. A
    formula of the last diagnosis is written into the study file first.

    Examples
    --------
    frictrack add study.toml texture
    frictrack add study.toml formula:1

    """
    _edit(lambda session, name: session.add(name, seed), study, effect, as_json)


@command()
def remove(study: Study, effect: Effect = None, seed: Seed = 0, as_json: Json = False) -> None:
    """Remove one effect from the current model and fit again.

    Shows the error before and after. Reads the runs and the current model. Writes the new model into study.h5.

    Examples
    --------
    frictrack remove study.toml texture
    frictrack remove study.toml viscous

    """
    _edit(lambda session, name: session.remove(name, seed), study, effect, as_json)


@command()
def history(study: Study = STUDY_HERE, as_json: Json = False) -> None:
    """List every model tried, in order, with its errors.

    Reads study.h5; outdated models are fitted again and stored.

    Examples
    --------
    frictrack history study.toml
    frictrack history study.toml --json > history.json

    """
    with open_session(study) as session:
        result = session.history()
    print_result(result, as_json, "history", session.path, look_at("compare"))


@command()
def plan(study: Study = STUDY_HERE, details: bool = False, as_json: Json = False) -> None:
    """Plan which runs to film next, to separate the effects.

    Reads mass, frame rate and scale from the study file, and the runs if there are any; no film is needed. Writes
    plan.html.

    Options
    -------
    details : print also what is assumed, what no run settles, and the detection limits

    Examples
    --------
    frictrack plan study.toml
    frictrack plan study.toml --json > plan.json

    """
    with progress_bars() as progress:
        result = flow.plan(flow.open_study(study, allow_incomplete=True), progress)
    print_result(result, as_json, "plan plan_details" if details else "plan", result["page"], look_at("plan"))


@command()
def report(study: Study = STUDY_HERE, pdf: bool = False, as_json: Json = False) -> None:
    """Write one page with all results.

    Reads all results; missing ones are computed first. Writes report.html.

    Options
    -------
    pdf : also print the page to report.pdf

    Examples
    --------
    frictrack report study.toml
    frictrack report study.toml --pdf

    """
    with open_session(study) as session:
        path = session.report()
    files = {"report": str(path)}
    if pdf:
        from frictrack.present.report import print_pdf  # noqa: PLC0415

        path = print_pdf(path)
        files["pdf"] = str(path)
    print_result({**files, "output": str(session.study.output)}, as_json, "", path, look_at("report"))


@command()
def export(  # noqa: PLR0913, PLR0917 - one argument per option
    study: Study = STUDY_HERE,
    to: FormatName = "csv",
    output: Path | None = None,
    recordings: bool = False,
    author: list[str] | None = None,
    licence: str | None = None,
    as_json: Json = False,
) -> None:
    """Export the results to another tool, the law as a prior, or everything as a research object.

    Reads all results; missing ones are computed first. Writes tables (csv, xlsx, parquet), one file for xarray or
    MATLAB (netcdf, mat), projects or texts of the video program Tracker (trk, txt), figures with their data (svg, pdf),
    a prior file with the values and covariance of the parameters that carry over to another set-up, or an RO-Crate with
    study file, recordings, results and report, which `frictrack reproduce` computes again. Shows what the format cannot
    hold.

    Options
    -------
    to : format; the guide on other tools says what each holds
    output -o --output : path of the prior file or of the crate: .zip, or a new folder (default: in the folder of
        results)
    recordings --include-recordings : crate: include films above 10 MB, too
    author NAME <ORCID> : crate: an author; may be repeated
    licence --license SPDX : crate: licence, as in CC-BY-4.0, or an address

    Examples
    --------
    frictrack export study.toml --to netcdf
    frictrack export study.toml --to crate --license CC-BY-4.0

    """
    if to != CRATE and (recordings or author or licence is not None):
        raise UsageError(f"expected --include-recordings, --author and --license only with --to {CRATE}")
    if to not in (CRATE, PRIOR) and output is not None:
        raise UsageError(
            f"expected -o only with --to {PRIOR} or {CRATE}; other files go into the folder of the results"
        )
    with open_session(study) as session:
        if to == CRATE:
            from frictrack.flow.crate import CrateOptions, write_crate  # noqa: PLC0415

            result = write_crate(session, output, CrateOptions(recordings, author or (), licence))
            where, look = result["crate"], look_at("crate", crate=result["crate"])
        elif to == PRIOR:
            result = session.export_prior(output)
            where, look = result["file"], look_at("prior")
        else:
            written = export_results(session.results(), to)
            files, lost = written.files, list(written.lost)
            result = {"files": [str(f) for f in files], "lost": lost, "output": str(session.study.output)}
            where = files[0].parent if len(files) > 1 else files[0]
            look = look_at("export", opened_by=FORMATS[to].opened_by.replace("v3", session.study.runs[0].name))
    print_result(result, as_json, to if to in (CRATE, PRIOR) else "export", where, look)
