"""The settings of global searches in Python, on the command line and in a study file; progress, Ctrl-C, convergence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.cli import study_commands  # noqa: F401 - its commands register themselves
from frictrack.cli.common import app
from frictrack.fit import restore, state
from frictrack.flow import Session, open_study, read_results
from frictrack.present import plots
from frictrack.study import parse

MODEL = ["coulomb", "viscous"]


@pytest.fixture(scope="module")
def runs() -> list[ft.Run]:
    return ft.samples.runs()[:2]


def search_of(session: Session, *arguments: str, **how: object) -> dict:
    return session.fit(*arguments, **how)["searched"]


# ---- Python


def test_a_fit_takes_a_record_of_settings_and_tells_it(runs: list[ft.Run]) -> None:
    fit = ft.fit(MODEL, runs, domain="force", search=ft.search.MGA(generations=25, population=20, p_const=0.05, seed=4))
    told = fit.summary()["searched"]
    assert (fit.search, fit.seed) == ("mga", 4)
    assert (told["method"], told["generations"], told["generation_limit"], told["ended"]) == (
        "mga",
        25,
        25,
        "generations",
    )
    assert told["settings"]["p_const"] == 0.05
    assert told["settings"]["a"] == pytest.approx(10 / 25)  # chosen here, and said
    assert told["evaluations"] == 20 + 25 * 18 + 20 * (
        len(np.unique([10, 11, 12, 13, 20])) - 1
    )  # coded anew four times
    same = ft.fit(MODEL, runs, domain="force", search=ft.search.MGA(generations=25, population=20, p_const=0.05), rng=4)
    np.testing.assert_array_equal(same.solution.p, fit.solution.p)


def test_settings_out_of_range_are_refused_before_the_fit(runs: list[ft.Run]) -> None:
    with pytest.raises(FrictrackError, match="search sga: expected population as a number of at least 4"):
        ft.search.SGA(population=2)
    with pytest.raises(FrictrackError, match="expected a search among varpro, ga"):
        ft.fit(MODEL, runs, search="genetic")


def test_the_convergence_of_a_fit_survives_its_state(runs: list[ft.Run]) -> None:
    fit = ft.fit(MODEL, runs, domain="force", search=ft.search.GA(generations=12, restarts=1))
    found = fit.convergence["all"]
    assert found.parameters == ("coulomb.F_c", "viscous.F_v")
    assert np.all(np.diff(found.best) <= 0)
    assert found.best[-1] == pytest.approx(fit.summary()["optima"][0]["misfit"])
    again = restore(fit.runs, state(fit))
    np.testing.assert_array_equal(again.convergence["all"].x, found.x)
    assert again.summary()["searched"] == fit.summary()["searched"]


def test_the_convergence_is_a_figure(runs: list[ft.Run]) -> None:
    fit = ft.fit(MODEL, runs, domain="force", search=ft.search.GA(generations=12, restarts=1))
    figure = fit.plot("convergence")
    drawn = plots.plotted_data(figure)
    best = drawn[drawn.curve == "best so far"]
    np.testing.assert_array_equal(best.y, fit.convergence["all"].best)
    share = drawn[drawn.curve == "coulomb.F_c"].y
    assert share.between(0, 1).all()
    assert "GA: misfit from" in figure.get_suptitle()
    with pytest.raises(
        FrictrackError, match="expected a fit by a global search to draw its convergence but got varpro"
    ):
        ft.fit(MODEL, runs).plot("convergence")
    with pytest.raises(FrictrackError, match='expected force or law or convergence but got "forces"'):
        fit.plot("forces")


def test_ctrl_c_keeps_the_best_so_far_and_says_so(runs: list[ft.Run]) -> None:
    def press(generation: int, *_: object) -> None:
        if generation == 7:
            raise KeyboardInterrupt

    fit = ft.fit(MODEL, runs, domain="force", search=ft.search.SGA(generations=200), callback=press)
    summary = fit.summary()
    assert summary["searched"]["ended"] == "interrupted"
    assert (
        "the search was stopped by hand after generation 7 of 200; these are its best values until then"
        in summary["remarks"]
    )
    whole = ft.fit(MODEL, runs, domain="force", search=ft.search.SGA(generations=200))
    np.testing.assert_array_equal(whole.convergence["all"].best[:8], fit.convergence["all"].best)


# ---- the study file


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('method = "mag"', r'\[search\], line 2: expected method as "varpro", "ga", .* but got "mag"'),
        ("generations = 5", "expected the key method but it is missing"),
        ('method = "mga"\npopulaton = 5', 'search mga: expected a setting among generations, .* but got "populaton"'),
        (
            'method = "ga"\npopulation = 2\nP_c = 1.5',
            "population as .* at least 4 .* got 2; expected crossover as .* 1.5",
        ),
        ('method = "varpro"\npopulation = 5', "expected no settings with varpro but got population"),
    ],
)
def test_faults_of_the_table_are_said_clearly(table: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FrictrackError, match=message):
        parse(tmp_path / "study.toml", f"[search]\n{table}\n", allow_incomplete=True)


def with_search(study_file: Path, table: str) -> Session:
    text = study_file.read_text().split("[search]")[0]
    study_file.write_text(f"{text}\n[search]\n{table}\n")
    return Session(open_study(study_file))


def test_the_study_file_sets_the_search_of_its_models(study_file: Path) -> None:
    session = with_search(study_file, 'method = "ga"\ngenerations = 6\nP_m = 0.1')
    told = search_of(session)
    assert (told["method"], told["generations"], told["settings"]["mutation"]) == ("ga", 6, 0.1)
    assert len(session.models.groups) == 1
    found = read_results(open_study(study_file))
    assert found.current is not None
    assert len(found.current.convergence["all"].best) == 7
    assert any(name.startswith("convergence") for name, _ in plots.study_figures(found))
    told = search_of(with_search(study_file, 'method = "ga"\ngenerations = 8\nP_m = 0.1'))  # changed: fitted again
    assert told["generations"] == 8
    assert len(session.models.groups) == 2
    assert "searched" not in session.fit(search="varpro")  # what is asked for wins
    assert "searched" not in session.fit()


# ---- the command line


def test_settings_are_typed_or_taken_from_the_study_file(study_file: Path) -> None:
    with_search(study_file, 'method = "mga"\npopulation = 12\nseed = 3')
    arguments = ["fit", str(study_file), "--json", "--set", "generations=5", "--set", "P_const=0.2"]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    told = json.loads(answer.stdout)["searched"]["settings"]
    assert (told["population"], told["generations"], told["p_const"], told["seed"]) == (12, 5, 0.2, 3)
    answer = CliRunner().invoke(app, [*arguments, "--seed", "9"])
    told = json.loads(answer.stdout)["searched"]["settings"]
    assert (told["seed"], told["generations"]) == (None, 5)  # --seed wins over the file


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--search", "mga", "--set", "generation=5"], 'among generations, .* as_printed but got "generation"'),
        (["--search", "ga", "--set", "population=many"], 'expected population as a whole number but got "many"'),
        (["--search", "ga", "--set", "population"], 'expected --set NAME=VALUE, .* but got "population"'),
        (
            ["--set", "population=30"],
            r"expected settings \(population\) with a global search .* but the search is varpro",
        ),
    ],
)
def test_wrong_settings_are_refused_before_anything_is_computed(
    arguments: list[str], message: str, study_file: Path
) -> None:
    answer = CliRunner().invoke(app, ["fit", str(study_file), *arguments])
    with pytest.raises(FrictrackError, match=message) as caught:
        raise answer.exception or AssertionError(answer.output)
    assert caught.value.usage
    assert not (study_file.parent / "study_results" / "study.h5").exists()


@pytest.mark.usefixtures("few_evaluations")
def test_a_stopped_search_is_searched_again_when_asked_again(study_file: Path) -> None:
    pressed = []

    def progress(done: int, total: int, what: str) -> None:
        if "generation" in what and done == 3 and not pressed:
            pressed.append((total, what))
            raise KeyboardInterrupt

    session = Session(open_study(study_file), progress)
    how = {"search": "ga", "domain": "force", "settings": {"generations": 20}}
    assert search_of(session, "coulomb,viscous", **how)["ended"] == "interrupted"
    assert pressed[0][0] == 20
    assert search_of(session)["ended"] == "interrupted"  # kept
    assert search_of(session, **how)["ended"] == "generations"
