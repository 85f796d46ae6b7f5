"""Define the commands on many studies or on none, and that of the page: effects, render, app, batch, verify, ..."""

from __future__ import annotations

import os
import sys
import webbrowser
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import typer

from frictrack import flow
from frictrack.base.errors import FrictrackError, UsageError, needs_package
from frictrack.base.files import read_small_text
from frictrack.cli.common import BatchPrinter, Json, Seed, Workers, app, command, look_at, print_result, progress_bars

TOKEN_VARIABLE = "FRICTRACK_TOKEN"  # environment: password of the page
MAX_TOKEN_BYTES = 10_000


@command()
def effects(
    given: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[STUDY] [EFFECT]...", help="study whose own effects are listed, too; effects to describe"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the effects that a model can have, or describe some.

    One line each; of an effect that is named, also equation, parameters with units, what it looks like, what it is
    confused with, how to confirm it, and the source. Reads the study file if one is given. Writes nothing.

    Examples
    --------
    frictrack effects
    frictrack effects study.toml texture

    """
    from frictrack.effects import catalogue, get  # noqa: PLC0415

    studies = [name for name in given or () if name.endswith(".toml") or (Path(name) / "study.toml").exists()]
    own = [effect for study in studies for effect in flow.user_effects(flow.open_study(Path(study)).effects)]
    named = [get(name, own) for name in given or () if name not in studies]
    names = {name for effect in named for name in (effect.name, effect.name.partition(":")[0])}
    found = [e for e in catalogue(own) if not names or names & {e["name"], e["name"].partition(":")[0]}]
    print_result({"effects": found}, as_json, "described_effects" if names else "effects")


@command()
def explain(
    words: Annotated[list[str], typer.Argument(metavar="WORD", help="words that frictrack prints, such as: held out")],
    as_json: Json = False,
) -> None:
    """Explain a word that frictrack prints; an effect is described as by `frictrack effects`.

    The same words are explained on the page and in the report where the pointer rests on them. Writes nothing.

    Examples
    --------
    frictrack explain held out
    frictrack explain patch

    """
    from frictrack.base.glossary import find_terms, near_words  # noqa: PLC0415
    from frictrack.effects import catalogue  # noqa: PLC0415

    library, word = catalogue(), " ".join(words)
    found = [{"words": list(term.words), "meaning": term.meaning} for term in find_terms(word)]
    same = [e for e in library if e["name"].replace("_", " ") == word.strip().lower().replace("_", " ")]
    if not found and not same:
        near = near_words(word, (e["name"] for e in library))
        advice = f"did you mean {', '.join(near)}?" if near else "`frictrack docs` has the glossary"
        raise FrictrackError(f'expected a word of the glossary or an effect but got "{word}"; {advice}')
    print_result({"terms": found, "effects": same}, as_json, "explain")


@command()
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="description of the slide and the camera")],
    out: Annotated[Path, typer.Option("-o", "--out", help="folder of the films and the study file")],
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Render synthetic films whose true motion is known.

    Reads the scene file; the documentation describes its keys. Writes the films, a study file without the truth, and
    truth.json.

    Examples
    --------
    frictrack render scene.toml -o films
    frictrack render scene.toml -o films --seed 3

    """
    from frictrack.simulate.scene import render_scene  # noqa: PLC0415

    with progress_bars() as progress:
        progress(0, 0, f"rendering {scene}")
        render_scene(scene, out, rng=seed, progress=progress)
    print_result({"output": str(out)}, as_json, "", out, look_at("render"))


@command("app")
def workbench(
    study: Annotated[Path, typer.Argument(metavar="[STUDY]", help="study file, or the folder of a new one")] = Path(),
    host: str = "127.0.0.1",
    port: int = 5006,
    token_file: Path | None = None,
    name: list[str] | None = None,
    browser: bool = True,
) -> None:
    """Open the workbench: the whole analysis on a local web page.

    Reads and writes the study file and its results. Without a study file, it makes one from the recordings in the
    folder.

    Options
    -------
    host : address of the server; 0.0.0.0 makes it reachable from other machines
    port : port of the server
    token_file : file with the password of the page (default: $FRICTRACK_TOKEN, else a new one each time)
    name : additional host name of the page, for example behind a proxy
    browser : open the page in the browser

    Examples
    --------
    frictrack app study.toml
    frictrack app study.toml --port 8080 --no-browser

    """
    with needs_package("the workbench", "frictrack[app]"):
        server = import_module("frictrack.workbench.server")  # by name: the two edges know nothing of each other
    server.serve(study, host=host, port=port, token=_page_token(token_file), names=name or (), show=browser)


def _page_token(file: Path | None) -> str | None:
    """Password of the page: of a file or the environment, because every user can read a command line."""
    if file is None:
        return os.environ.get(TOKEN_VARIABLE)
    found = read_small_text(file, MAX_TOKEN_BYTES, "a file with the password of the page").strip()
    if not found:
        raise UsageError(f"expected the password of the page in {file} but it is empty; write one")
    return found


@command()
def batch(
    paths: Annotated[list[str], typer.Argument(metavar="PATH...", help="study files, folders, or globs")],
    workers: Workers = None,
    scheduler: str | None = None,
    output: Path = Path("frictrack_batch"),
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Run many studies in parallel.

    Reads study files and their recordings. Writes the results of every study, and frictrack_batch.csv and .html
    with all runs, trends over the series and failures. Run it again to process only missing or changed studies.

    Options
    -------
    scheduler ADDRESS : address of a Dask scheduler whose workers are used
    output -o --output : path of the output files, without suffix

    Examples
    --------
    frictrack batch campaign
    frictrack batch "campaign/*/study.toml" -o all --workers 8

    """
    from frictrack.flow.batch import batch as run_all  # noqa: PLC0415

    with progress_bars() as progress:
        watch = BatchPrinter(progress)
        result = run_all(paths, output, seed, workers=workers, scheduler=scheduler, watch=watch)
    print_result(result, as_json, "batch", result["output"], look_at("batch"))
    if result["failed"]:
        failed = {one["study"] for one in result["failed"]}
        raise FrictrackError(f"{len(failed)} of {len(result['studies'])} studies failed; see {result['output']}")


@command()
def verify(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="study files, results, or folders with them")],
    as_json: Json = False,
) -> None:
    """Verify that stored results are undamaged and up to date.

    Reads study files, results and recordings. Writes nothing. Exits with 1 if there are faults.

    Examples
    --------
    frictrack verify study.toml
    frictrack verify campaign

    """
    with progress_bars() as progress:
        result = flow.verify(paths, progress)
    print_result(result, as_json, "verify")
    if not result["sound"]:
        n = len(result["faults"])
        raise FrictrackError(f"{n} fault(s) in {result['files']} file(s); each line above says what to do")


@command()
def demo(seed: Seed = 0, as_json: Json = False) -> None:
    """Run the whole analysis on a sample study.

    Writes the study and its results into ./frictrack_demo.

    Examples
    --------
    frictrack demo
    frictrack demo --json > demo.json

    """
    with progress_bars() as progress:
        progress(0, 0, "opening the sample study in frictrack_demo")
        result = flow.demo(Path("frictrack_demo"), seed, progress)
    print_result(result, as_json, "demo", result["report"], look_at("demo"))


@command()
def docs(where: bool = False, as_json: Json = False) -> None:
    """Open the documentation in the browser.

    Looks for the pages in the installed package, then in docs/_build/html of a checkout. Writes nothing.

    Options
    -------
    where --path : print the place of the pages, open no browser

    Examples
    --------
    frictrack docs
    frictrack docs --path

    """
    page = _documentation()
    if as_json:
        print_result({"output": str(page)}, True, "")
    elif where or not webbrowser.open(page.as_uri()):
        sys.stdout.write(f"{page}\n")


def _documentation() -> Path:
    """Return the first page of the documentation."""
    package = Path(__file__).parents[1]
    places = (package / "pages" / "index.html", package.parent / "docs" / "_build" / "html" / "index.html")
    found = next((page for page in places if page.is_file()), None)
    if found is None:
        raise FrictrackError(
            f"expected the documentation in {places[0].parent} or {places[1].parent} but found none; in a checkout, "
            "`sphinx-build docs docs/_build/html` builds it"
        )
    return found


@command()
def reproduce(  # noqa: PLR0913, PLR0917 - one argument per option
    crate: Annotated[
        Path | None, typer.Argument(metavar="CRATE", help="crate of a study, from `frictrack export --to crate`")
    ] = None,
    recordings: Path | None = None,
    allow_addresses: bool = False,
    quick: bool = False,
    out: Path = Path("frictrack_reproduce"),
    seed: int = 0,
    as_json: Json = False,
) -> None:
    """Compute the results of a crate again and compare every number; without a crate, reproduce both papers.

    Of a crate: reads it and the recordings, and repeats the study in a new folder with the same settings and seeds.
    Exits with 1 if a number differs: bit for bit on the same platform; on another one to a relative 1e-9, and
    uncertainties, misfits and detection limits to the digits that they have. Of the papers: compares the printed values
    with those computed here and checks every claim, in about five minutes of processor time. Writes a page, figures,
    tables and JSON; a call that was interrupted goes on with the same options.

    Options
    -------
    recordings FOLDER : where the recordings are that the crate does not contain
    allow_addresses : of a crate: fetch missing recordings from where its author had them
    quick : papers: use few seeds, a test run without statistics
    out -o --out : folder of what is computed; of a crate, a new one
    seed : papers: seed of all random numbers

    Examples
    --------
    frictrack reproduce study.crate.zip --recordings films
    frictrack reproduce --quick -o papers

    """
    if crate is not None:
        if quick or seed:
            raise UsageError("expected no --quick and no --seed with a crate, which has its own seeds")
        _reproduce_crate(crate, out, recordings, as_json, allow_addresses=allow_addresses)
        return
    if recordings is not None or allow_addresses:
        option = "--allow-addresses" if recordings is None else "--recordings"
        raise UsageError(f"expected a crate together with {option}")
    from frictrack.validation.reproduce import reproduce as make  # noqa: PLC0415

    with progress_bars() as progress:
        result = make(out, quick=quick, seed=seed, progress=progress)
    print_result(result, as_json, "reproduce", result["page"])


def _reproduce_crate(crate: Path, out: Path, recordings: Path | None, as_json: bool, *, allow_addresses: bool) -> None:
    """Compute the results of a crate again and compare them."""
    from frictrack.flow.crate import reproduce_crate  # noqa: PLC0415

    with progress_bars() as progress:
        result = reproduce_crate(crate, out, recordings, progress, allow_addresses=allow_addresses)
    print_result(result, as_json, "reproduced_crate", result["output"])
    if not result["equal"]:
        n = sum(group["n_differences"] for group in result["groups"])
        raise FrictrackError(f"{n} value(s) differ from those in {crate}; the rows marked NO above name them")


blind = typer.Typer(
    help="Test the diagnosis on simulated studies with hidden effects.",
    no_args_is_help=True,
    epilog="\b\nExamples:\n  frictrack blind make trial --n 40\n  frictrack blind score trial",
)
app.add_typer(blind, name="blind", rich_help_panel=None)
Blind = Annotated[Path, typer.Argument(metavar="OUT", help="folder of the studies and their sealed truth")]


@command(group=blind)
def make(  # noqa: PLR0913, PLR0917 - the options of the command
    out: Blind,
    n: int | None = None,
    film: bool = False,
    kind: Literal["one", "none", "two", "three", "foreign", "fault"] | None = None,
    workers: Workers = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Write simulated studies and seal the effects that they hide.

    A study hides one effect, none, two, or one that the library does not have (of 420: 200, 100, 60 and 60). Of 40
    films, 20 hide one effect, 10 none, and 10 a fault of the measurement. Writes the studies and the sealed truth.

    Options
    -------
    n --n : number of studies (default: 420, or 40 with --film)
    film : write rendered films, which are tracked
    kind : only studies of this kind

    Examples
    --------
    frictrack blind make trial --n 40
    frictrack blind make trial --film --seed 7

    """
    from frictrack.validation.blind import make as written  # noqa: PLC0415

    with progress_bars() as progress:
        result = written(out, n, seed=seed, film=film, kind=kind, workers=workers, progress=progress)
    print_result(result, as_json, "", out)


@command(group=blind)
def score(out: Blind, workers: Workers = None, seed: Seed = 0, as_json: Json = False) -> None:
    """Diagnose the blind studies, open the seal and count.

    Reads the studies; adds the effects that are named. Writes score.json. An interrupted run continues where it
    stopped.

    Examples
    --------
    frictrack blind score trial
    frictrack blind score trial --workers 4

    """
    from frictrack.validation.blind import score as scored  # noqa: PLC0415

    with progress_bars() as progress:
        result = scored(out, seed=seed, workers=workers, progress=progress)
    print_result(result, as_json, "blind", out / "score.json")
