"""The commands on one study. Each brings up to date what it rests on, shows it, and says where it is."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from frictrack.cli.common import Effect, Json, Search, Seed, Study, app, open_session, print_result
from frictrack.errors import FrictrackError

if TYPE_CHECKING:
    from frictrack.flow import Session


@app.command()
def run(
    paths: Annotated[list[Path], typer.Argument(metavar="STUDY | RECORDING...", help="a study file, or recordings")],
    mass: Annotated[str | None, typer.Option(help='of the slider, "0.35kg"; with recordings')] = None,
    scale: Annotated[str | None, typer.Option(help='"0.5mm/px"; with recordings')] = None,
    fps: Annotated[float | None, typer.Option(help="frame rate while filming, 1/s; with recordings")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Every stage, then fit, compare, diagnose, report. Bare recordings get a study.toml in this folder."""
    path = _study_of(paths, {"mass": mass, "fps": fps, "scale": scale})
    with open_session(path) as session:
        result = session.run(seed)
    print_result(result, as_json, "run", session.study.output / "report.html")


def _study_of(paths: list[Path], keys: dict[str, Any]) -> Path:
    """The study file that is meant, written from bare recordings where these are given."""
    from frictrack.flow import start_study  # noqa: PLC0415
    from frictrack.study import TABLES  # noqa: PLC0415

    one = paths[0]
    given = [key for key, value in keys.items() if value is not None]
    if one.suffix == ".toml" or (one / "study.toml").exists():
        if len(paths) > 1:
            raise FrictrackError("expected one study file; `frictrack batch` runs several", usage=True)
        if given:
            raise FrictrackError(f"expected no --{given[0]} beside a study file, it stands in it", usage=True)
        return one
    if one.is_dir() and not given:
        raise FrictrackError(f"expected a study.toml in {one}; `frictrack init {one}` writes one", usage=True)
    filmed = any(path.suffix.lower() not in TABLES for path in paths)
    lacking = [f"--{key}" for key in (("mass", "scale") if filmed else ("mass",)) if key not in given]
    if lacking:
        example = "--mass 0.35kg --scale 0.5mm/px --fps 4000"
        raise FrictrackError(f"expected {' and '.join(lacking)} beside recordings, as in {example}", usage=True)
    return start_study(Path("study.toml"), paths, keys).path


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder with recordings")], as_json: Json = False
) -> None:
    """Write a commented study file from a folder of recordings."""
    from frictrack.study import find_recordings, write_study  # noqa: PLC0415

    found = find_recordings(folder)
    path = write_study(folder / "study.toml", found, commented=True)
    result = {"study": str(path), "runs": [p.name for p in found], "output": str(path)}
    print_result(result, as_json, "", f"{path}; fill in mass, fps and scale, then `frictrack run {path}`")


def _measure(stage: str, study: Path, as_json: bool) -> None:
    with open_session(study) as session:
        result = session.measure(stage)
    print_result(result, as_json, "stages", session.study.output)


@app.command()
def track(
    study: Study,
    overlay: Annotated[bool, typer.Option("--overlay", help="write each film with what was tracked in it")] = False,
    as_json: Json = False,
) -> None:
    """Follow the slider through every film; a contact sheet shows whether that went well."""
    with open_session(study) as session:
        result = session.measure("track", overlay=overlay)
    print_result(result, as_json, "track", session.study.output)


@app.command()
def motion(study: Study, as_json: Json = False) -> None:
    """Displacement, velocity and acceleration of every run."""
    _measure("motion", study, as_json)


@app.command()
def friction(study: Study, as_json: Json = False) -> None:
    """The friction force of every run, and the section it is judged on."""
    _measure("friction", study, as_json)


@app.command()
def fit(  # noqa: PLR0913, PLR0917 - the flags of DESIGN section 6
    study: Study,
    model: Annotated[str | None, typer.Option(help="a model (tustin, atm1:2) or a comma list of effects")] = None,
    search: Annotated[Search | None, typer.Option(help="how parameters are sought (varpro)")] = None,
    over: Annotated[
        Literal["all", "nonlinear"] | None, typer.Option(help="what a global search looks for (all)")
    ] = None,
    domain: Annotated[Literal["displacement", "force"] | None, typer.Option(help="what is compared")] = None,
    per: Annotated[Literal["group"] | None, typer.Option(help="one set of parameters per group of runs")] = None,
    seed: Annotated[int | None, typer.Option(help="of all that is drawn at random (0)")] = None,
    profile: Annotated[bool, typer.Option("--profile", help="95 % intervals by profile likelihood")] = False,
    bootstrap: Annotated[int, typer.Option(metavar="N", help="95 % intervals by so many parametric draws")] = 0,
    as_json: Json = False,
) -> None:
    """Fit the current model, or another one that becomes the current one."""
    with open_session(study) as session:
        how: dict[str, Any] = {"search": search, "over": over, "domain": domain, "per": per, "seed": seed}
        result = session.fit(model, profiles=profile, draws=bootstrap, **how)
    print_result(result, as_json, "fit", session.path)


@app.command()
def compare(study: Study, as_json: Json = False) -> None:
    """Error of every model tried, and where the current one fails."""
    with open_session(study) as session:
        result = session.compare()
    print_result(result, as_json, "compare", session.path)


@app.command()
def diagnose(study: Study, seed: Seed = 0, as_json: Json = False) -> None:
    """Which effect is missing."""
    with open_session(study) as session:
        result = session.diagnose(seed)
    print_result(result, as_json, "diagnose", session.path)


def _edit(how: Callable[[Session], dict[str, Any]], study: Path, as_json: bool) -> None:
    with open_session(study) as session:
        result = how(session)
    print_result(result, as_json, "edit", session.path)


@app.command()
def add(study: Study, effect: Effect, seed: Seed = 0, as_json: Json = False) -> None:
    """Fit again with one effect more; the error before and after."""
    _edit(lambda session: session.add(effect, seed), study, as_json)


@app.command()
def remove(study: Study, effect: Effect, seed: Seed = 0, as_json: Json = False) -> None:
    """Fit again with one effect less; the error before and after."""
    _edit(lambda session: session.remove(effect, seed), study, as_json)


@app.command()
def history(study: Study, as_json: Json = False) -> None:
    """Every model tried, in order, with its errors."""
    with open_session(study) as session:
        result = session.history()
    print_result(result, as_json, "history", session.path)


@app.command()
def plan(study: Study, as_json: Json = False) -> None:
    """Which runs to film so that the effects can be told apart; needs mass, fps and scale, and no film."""
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415
    from frictrack.flow import open_study  # noqa: PLC0415
    from frictrack.flow import plan as make  # noqa: PLC0415

    with progress_bars() as progress:
        result = make(open_study(study, allow_no_runs=True), progress)
    print_result(result, as_json, "plan", result["page"])


@app.command()
def report(
    study: Study,
    pdf: Annotated[bool, typer.Option("--pdf", help="print it to report.pdf as well")] = False,
    as_json: Json = False,
) -> None:
    """One page that shows it all."""
    with open_session(study) as session:
        path = session.report()
    files = {"report": str(path)}
    if pdf:
        from frictrack.report import print_pdf  # noqa: PLC0415

        path = print_pdf(path)
        files["pdf"] = str(path)
    print_result({**files, "output": str(session.study.output)}, as_json, "", path)


@app.command()
def export(
    study: Study,
    to: Annotated[Literal["csv", "xlsx"], typer.Option(help="kind of file")] = "csv",
    as_json: Json = False,
) -> None:
    """Curves, parameters and errors as plain tables."""
    from frictrack.export import write  # noqa: PLC0415

    with open_session(study) as session:
        files = write(session.results(), to)
    where = files[0].parent if len(files) > 1 else files[0]
    print_result({"files": [str(f) for f in files], "output": str(session.study.output)}, as_json, "", where)


@app.command()
def effects(
    study: Annotated[Path | None, typer.Argument(metavar="[STUDY]", help="whose own formulas are listed too")] = None,
    as_json: Json = False,
) -> None:
    """The library: equations, parameters with units, what an effect looks like and is mistaken for."""
    from frictrack.effects import catalogue  # noqa: PLC0415
    from frictrack.flow import open_study, user_effects  # noqa: PLC0415

    own = [] if study is None else user_effects(open_study(study).effects)
    print_result({"effects": catalogue(own)}, as_json, "effects")


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="what slides, and how it is filmed")],
    out: Annotated[Path, typer.Option("-o", "--out", help="the film to write")],
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """A synthetic recording with its truth."""
    from frictrack.simulate.scene import render_scene  # noqa: PLC0415

    render_scene(scene, out, seed=seed)
    print_result({"output": str(out)}, as_json, "", out)


@app.command("app")
def workbench(
    study: Annotated[Path, typer.Argument(metavar="[STUDY]", help="study file, or the folder of a new one")] = Path(),
    host: Annotated[str, typer.Option(help="address on which it is served; 0.0.0.0 for other machines")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="of the page")] = 5006,
    token: Annotated[str | None, typer.Option(help="word that the page asks for (a new one each time)")] = None,
    name: Annotated[list[str] | None, typer.Option(help="further host name of the page, as behind a proxy")] = None,
    browser: Annotated[bool, typer.Option(help="open the page in the browser")] = True,
) -> None:
    """The workbench: the whole loop on a local page. Without a study it makes one from recordings."""
    try:
        server = import_module("frictrack.workbench.server")  # by name: the two edges know nothing of each other
    except ModuleNotFoundError as e:
        raise FrictrackError(f'the workbench needs {e.name}; pip install "frictrack[app]"') from e
    server.serve(study, host=host, port=port, token=token, names=name or (), show=browser)
