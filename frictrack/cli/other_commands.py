"""The commands that work on many studies, or on none: batch, verify, blind, reproduce, demo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictrack.cli.common import Json, Seed, Workers, app, print_result
from frictrack.errors import FrictrackError


@app.command()
def batch(
    paths: Annotated[list[str], typer.Argument(metavar="PATH...", help="study files, folders, or globs")],
    workers: Workers = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="of a Dask cluster that does it")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="what is written, without an ending")] = Path(
        "frictrack_batch"
    ),
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Run many studies side by side: a table of all runs, what changes over the series, what failed and why.

    Begun again, it does what is missing or has changed.
    """
    from frictrack.batch import batch as run_all  # noqa: PLC0415
    from frictrack.cli.batch_progress import watch_batch  # noqa: PLC0415

    with watch_batch() as watch:
        result = run_all(paths, output, seed, workers=workers, scheduler=scheduler, watch=watch)
    print_result(result, as_json, "batch", result["output"])
    if result["failed"]:
        failed = {one["study"] for one in result["failed"]}
        raise FrictrackError(
            f"something failed in {len(failed)} of {len(result['studies'])} studies; {result['output']} says why"
        )


@app.command()
def verify(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="studies, results, or folders of them")],
    as_json: Json = False,
) -> None:
    """Find silent damage: checksums, schema, where results come from, and whether recordings are still the same."""
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415
    from frictrack.flow import verify as look  # noqa: PLC0415

    with progress_bars() as progress:
        result = look(paths, progress)
    print_result(result, as_json, "verify")
    if not result["sound"]:
        n = len(result["faults"])
        raise FrictrackError(f"{n} fault(s) in {result['files']} file(s); each line says what to do")


@app.command()
def demo(seed: Seed = 0, as_json: Json = False) -> None:
    """The whole loop on a sample study, in ./frictrack_demo."""
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415
    from frictrack.flow import demo as show_it  # noqa: PLC0415

    with progress_bars() as progress:
        result = show_it(Path("frictrack_demo"), seed, progress)
    print_result(result, as_json, "demo", result["report"])


@app.command()
def reproduce(
    quick: Annotated[bool, typer.Option("--quick", help="few seeds: everything runs, nothing is proved")] = False,
    out: Annotated[Path, typer.Option("-o", "--out", help="folder for page, figures, tables and JSON")] = Path(
        "frictrack_reproduce"
    ),
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Tables and figures of both papers again: printed values beside ours, and which claims hold."""
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415
    from frictrack.reproduce import reproduce as make  # noqa: PLC0415

    with progress_bars() as progress:
        result = make(out, quick=quick, seed=seed, progress=progress)
    print_result(result, as_json, "reproduce", result["page"])


blind = typer.Typer(help="Studies with a sealed truth: how surely is what they hide named?", no_args_is_help=True)
app.add_typer(blind, name="blind", rich_help_panel=None)
Blind = Annotated[Path, typer.Argument(metavar="OUT", help="folder of the studies and their seal")]


@blind.command()
def make(
    out: Blind,
    n: Annotated[int | None, typer.Option("--n", help="how many studies (420; 40 of films)")] = None,
    film: Annotated[bool, typer.Option("--film", help="as rendered films, through tracking")] = False,
    workers: Workers = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Write studies, and seal what they hide: one effect, none, two, or one that the library does not know.

    Of 420: 200, 100, 60 and 60. Of 40 films: 20 with one effect, 10 with none, 10 with a fault of the measurement.
    """
    from frictrack.blind import make as written  # noqa: PLC0415
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415

    with progress_bars() as progress:
        result = written(out, n, seed=seed, film=film, workers=workers, progress=progress)
    print_result(result, as_json, "", out)


@blind.command()
def score(out: Blind, workers: Workers = None, seed: Seed = 0, as_json: Json = False) -> None:
    """Diagnose every study, add what is named, open the seal and count. Goes on where it was interrupted."""
    from frictrack.blind import score as scored  # noqa: PLC0415
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415

    with progress_bars() as progress:
        result = scored(out, seed=seed, workers=workers, progress=progress)
    print_result(result, as_json, "blind", out / "score.json")
