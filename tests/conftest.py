"""Studies of known truth that several tests use."""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Open, Serve, Server, Tab, browser
from filelock import FileLock
from page_client import Client

from frictrack.diagnose import conclusion
from frictrack.fit import global_search
from frictrack.flow import Session, open_study
from frictrack.flow.tried_models import TriedModels
from frictrack.samples import copy_films

MASS, F_C, F_V = 0.35, 1.2, 0.4  # kg, N, N s/m
SPEEDS = {"slow": 2.0, "middle": 3.0, "fast": 3.5}  # m/s
NOISE = 10e-6  # m
WHOLE_PAPERS_ROUTE = TriedModels.fit_papers_route
SHARES = 80  # of the slow tests, for CI

STUDY = """
[study]
name = "three tables"
mass = "0.350 +/- 0.002 kg"
model = ["coulomb", "viscous"]
"""


def slide(t: np.ndarray, v0: float) -> np.ndarray:
    """Displacement of a slider under Coulomb and viscous friction, m (closed form, before it stops)."""
    decay = F_V / MASS
    return (v0 + F_C / F_V) / decay * (1 - np.exp(-decay * t)) - F_C / F_V * t


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--share",
        metavar="COMMIT",
        help=f"of the slow tests only the one of {SHARES} shares that this hash of a commit chooses",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure() -> None:
    """Let every test process use one thread: further threads of linear algebra would only wait for the cores."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the further cases of `few` tests as slow, and keep only a share of the slow tests if asked.

    Every slow test is in one of the shares, but for those that take minutes alone. Each has some of every large file
    and table of cases, so that all cost about the same.
    """
    families: dict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        if item.get_closest_marker("few") and not item.get_closest_marker("slow"):
            families[item.nodeid.partition("[")[0]].append(item)
    for cases in families.values():
        n = cases[0].get_closest_marker("few").args[0]
        kept = np.linspace(0, len(cases) - 1, n).round()  # the first, the last, and some between
        for i, case in enumerate(cases):
            if i not in kept:
                case.add_marker("slow")
    commit = config.getoption("--share")
    if commit:
        slow = [item for item in items if item.get_closest_marker("slow")]
        lot = [item for item in slow if not item.get_closest_marker("release")]
        others = set(slow) - set(lot[int(commit, 16) % SHARES :: SHARES])
        config.hook.pytest_deselected(items=list(others))
        items[:] = [item for item in items if item not in others]


@pytest.fixture(scope="session", autouse=True)
def _short_papers_route() -> Iterator[None]:
    """End the fit by the papers' route that belongs to every report early; searches that a test asks for do not."""

    def short(models: TriedModels) -> None:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(global_search, "MAX_EVALUATIONS", 2000)
            WHOLE_PAPERS_ROUTE(models)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(TriedModels, "fit_papers_route", short)
        yield


def write_tables(folder: Path) -> Path:
    """A study of three table runs that Coulomb + viscous friction made."""
    rng = np.random.default_rng(1)
    t = np.arange(500) / 4000
    text = STUDY
    for name, v0 in SPEEDS.items():
        x = slide(t, v0) + NOISE * rng.normal(size=len(t))
        np.savetxt(folder / f"{name}.csv", np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")
        text += f'\n[[run]]\nname = "{name}"\ntable = "{name}.csv"\n'
    path = folder / "study.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="session")
def measured_tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the study of three tables, its motion computed once for all tests: copy it."""
    folder = tmp_path_factory.mktemp("measured")
    Session(open_study(write_tables(folder))).bring_up_to("motion")
    return folder


@pytest.fixture
def new_study_file(tmp_path: Path) -> Path:
    """The study of three tables before any work."""
    return write_tables(tmp_path)


@pytest.fixture
def study_file(measured_tables: Path, tmp_path: Path) -> Path:
    """The study of three tables with the motion of its runs; the rest is to be done."""
    shutil.copytree(measured_tables, tmp_path, dirs_exist_ok=True)
    return tmp_path / "study.toml"


@pytest.fixture(scope="session")
def finished_sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the sample study with its verdict and its report, computed once for all processes: copy it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = shared / "finished_sample"
    with FileLock(shared / "finished_sample.lock"):
        if not (folder / "study_results" / "report.html").exists():
            folder.mkdir()
            Session(open_study(copy_films(folder))).run()
    return folder


@pytest.fixture
def few_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Global searches of a fit end early: for tests that do not ask how near they come."""
    monkeypatch.setattr(global_search, "MAX_EVALUATIONS", 4000)


@pytest.fixture
def no_formulas(monkeypatch: pytest.MonkeyPatch) -> None:
    """A diagnosis does not ask whether a formula explains as much as the effects that it names."""
    monkeypatch.setattr(conclusion, "compare_with_formulas", lambda *_: None)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser."""
    with browser() as one:
        yield one


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Starts servers of the page that run until the test and its tabs are over."""
    with ExitStack() as servers:

        def start(study: Path, **options: Any) -> Server:
            server = Server(study, **options).start()
            servers.callback(server.stop)
            return server

        yield start


@pytest.fixture
def tables(study_file: Path, serve: Serve) -> Server:
    """A study of three tables whose motion is known."""
    return serve(study_file)


@pytest.fixture(scope="session")
def sample(finished_sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The sample study after `run`, for all tests of a process; they undo what they change."""
    folder = tmp_path_factory.mktemp("page") / "study"
    shutil.copytree(finished_sample, folder)
    server = Server(folder / "study.toml").start()
    yield server
    server.stop()


@pytest.fixture
def tab(chromium: Any, serve: Serve) -> Iterator[Open]:
    """Opens tabs; at the end none of them has asked anybody outside, or met an error."""
    opened: list[Tab] = []

    def new() -> Tab:
        opened.append(Tab(chromium.new_page(viewport={"width": 1280, "height": 900})))
        return opened[-1]

    yield new
    for one in opened:
        one.page.close()
    assert [fault for one in opened for fault in one.faults] == []


Clients = Callable[..., Client]  # a study file or folder, and a server that runs already


@pytest.fixture
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Clients]:
    """Open clients of a server; at the end the server has written no traceback."""
    clients: list[Client] = []
    log = tmp_path_factory.mktemp("log") / "server.txt"

    def new(study: Path, server: Server | None = None) -> Client:
        clients.append(Client(server or Server(study, log=log).start()))
        return clients[-1]

    yield new
    for client in clients:
        client.close()
        if client.server.process is not None and client.server.process.poll() is None:
            client.server.stop()
    text = log.read_text() if log.exists() else ""
    assert "Traceback" not in text, text


@pytest.fixture(scope="module")
def shared(measured_tables: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """One server for tests that change nothing."""
    folder = tmp_path_factory.mktemp("shared")
    shutil.copytree(measured_tables, folder, dirs_exist_ok=True)
    log = tmp_path_factory.mktemp("log") / "server.txt"
    client = Client(Server(folder, log=log).start())
    yield client
    client.close()
    client.server.stop()
    assert "Traceback" not in log.read_text()


@pytest.fixture
def fitted(study_file: Path) -> Path:
    """The study of three tables with one fitted model."""
    Session(open_study(study_file)).fit()
    return study_file
