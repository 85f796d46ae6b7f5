"""A study as a research object: what others read in it, and whether its results come out again elsewhere."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from camera_films import write_photron
from conftest import STUDY, WHOLE_PAPERS_ROUTE, slide
from range_server import serving

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.base.files import CACHE_VARIABLE
from frictrack.cli import main
from frictrack.flow import Session, open_study, store, stored_values
from frictrack.flow.crate import CrateOptions, payload, read_authorship, reproduce_crate, ucum, write_crate
from frictrack.flow.crate.payload import safe_place, unpack
from frictrack.flow.crate.reproducing import Crate, compare_files, find_inputs, read_crate, tolerance_of
from frictrack.flow.store import GroupContent
from frictrack.flow.tried_models import TriedModels
from frictrack.records import Friction

ROOT = Path(__file__).parents[1]
AUTHORS = ("Ada Lovelace <0000-0002-1825-0097>", "Charles Babbage")


def write_table(path: Path, v0: float, seed: int) -> None:
    t = np.arange(150) / 2000
    x = slide(t, v0) + 1e-5 * np.random.default_rng(seed).normal(size=len(t))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")


@pytest.fixture(scope="module", autouse=True)
def _whole_papers_route() -> Iterator[None]:
    """As another process has it, which computes the results again."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(TriedModels, "fit_papers_route", WHOLE_PAPERS_ROUTE)
        yield


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two tables, one outside its folder, with two models; the first is current and diagnosed twice."""
    folder = tmp_path_factory.mktemp("lab") / "study"
    write_table(folder / "tables" / "slow.csv", 1.0, 1)
    write_table(folder.parent / "elsewhere" / "fast.csv", 3.0, 2)
    runs = '\n[[run]]\ntable = "tables/slow.csv"\n\n[[run]]\ntable = "../elsewhere/fast.csv"   # of another day\n'
    (folder / "study.toml").write_text(STUDY + runs)
    session = Session(open_study(folder))
    session.fit(profiles=True)
    session.diagnose(quick=True)
    Session(open_study(folder)).diagnose(3)  # another seed: a new sequence of tests, at a smaller level
    session.attempt("slope")
    session.add("slope")  # takes the fit from there
    session.apply("use", model="1_coulomb+viscous")
    session.diagnose(3)
    return folder / "study.toml"


@pytest.fixture(scope="module")
def crate(study: Path) -> Path:
    """The crate of that study."""
    made = write_crate(Session(open_study(study)), options=CrateOptions(authors=AUTHORS, licence="CC-BY-4.0"))
    return Path(made["crate"])


@pytest.fixture
def folder(crate: Path, tmp_path: Path) -> Path:
    """The unpacked crate."""
    unpack(crate, tmp_path / "unpacked")
    return tmp_path / "unpacked"


def metadata(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "ro-crate-metadata.json").read_text(encoding="utf-8"))
    return found


@pytest.mark.slow
def test_the_reader_of_the_ro_crate_project_finds_everything(crate: Path) -> None:
    from rocrate.rocrate import ROCrate  # noqa: PLC0415 - only this test needs it

    found = ROCrate(crate)
    root = found.root_dataset
    assert root["conformsTo"].id == "https://w3id.org/ro/wfrun/process/0.5"
    assert root["license"].id == "https://spdx.org/licenses/CC-BY-4.0"
    assert [one["name"] for one in root["author"]] == ["Ada Lovelace", "Charles Babbage"]
    assert found.mainEntity.id == "study.toml"
    action = root["mentions"]
    assert action.type == "CreateAction"
    assert action["instrument"]["name"] == "frictrack"
    packages = {one["name"]: one["softwareVersion"] for one in action["instrument"]["softwareRequirements"]}
    assert packages["numpy"] == np.__version__
    assert {one.id for one in action["object"]} >= {"study.toml", "tables/slow.csv", "inputs/1/fast.csv"}
    assert {one.id for one in action["result"]} >= {"study_results/study.h5", "study_results/report.html"}
    with zipfile.ZipFile(crate) as file:
        names = {*file.namelist()} - {"ro-crate-metadata.json"}
    assert {one.id for one in root["hasPart"]} == names


def test_rules_of_the_specification(folder: Path) -> None:
    """RO-Crate 1.1: flat JSON-LD, one object per @id, no lists of one, references that lead somewhere, a date."""
    graph = metadata(folder)["@graph"]
    by_id = {one["@id"]: one for one in graph}
    assert len(by_id) == len(graph)
    descriptor, root = by_id["ro-crate-metadata.json"], by_id["./"]
    assert descriptor["about"] == {"@id": "./"}
    assert descriptor["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    assert root["@type"] == "Dataset"
    assert root["name"]
    assert root["description"]
    assert root["datePublished"].startswith("20")
    for entity in graph:
        assert "@type" in entity
        for key, values in entity.items():
            assert not isinstance(values, list) or len(values) > 1, (entity["@id"], key)
            for value in values if isinstance(values, list) else [values]:
                if isinstance(value, dict):
                    assert set(value) == {"@id"}
                    assert value["@id"] in by_id or value["@id"] == "https://w3id.org/ro/crate/1.1"


def test_parameters_have_units_and_uncertainty(folder: Path, study: Path) -> None:
    by_id = {one["@id"]: one for one in metadata(folder)["@graph"]}
    named = {one.get("propertyID"): one for one in by_id.values()}
    viscous = named["1_coulomb+viscous/viscous.F_v"]
    known = Session(open_study(study)).fit()["parameters"]["viscous.F_v"]
    assert viscous["value"] == known["value"]
    assert viscous["unitCode"] == "ucum:N.s/m"
    assert viscous["unitText"] == "N.s/m"
    beside = {by_id[one["@id"]]["name"]: by_id[one["@id"]] for one in viscous["valueReference"]}
    assert beside["standard uncertainty"]["value"] == known["std"]
    assert beside["95 % interval"]["minValue"] < known["value"] < beside["95 % interval"]["maxValue"]


def test_tables_hold_parameters_and_budgets(folder: Path, study: Path) -> None:
    tables = {path.stem: pd.read_csv(path) for path in (folder / "study_results" / "tables").glob("*.csv")}
    assert tables.keys() == {"parameters", "errors", "budget"}
    known = Session(open_study(study)).fit()["parameters"]["viscous.F_v"]
    found = tables["parameters"].query("model == '1_coulomb+viscous'").set_index("parameter").loc["viscous.F_v"]
    assert (found["value"], found["std"], found["unit"]) == (known["value"], known["std"], "N s/m")
    *sources, total = tables["budget"].query("run == 'slow'")["mean_N"].dropna()
    assert total == pytest.approx(np.sqrt(np.sum(np.square(sources))))  # GUM 5.1.2, no correlation


@pytest.mark.slow
def test_computed_again_elsewhere_everything_is_equal(crate: Path, tmp_path: Path) -> None:
    """Another process in another folder, with an empty home, that has only the crate."""
    away, home = tmp_path / "away", tmp_path / "home"
    away.mkdir()
    home.mkdir()
    shutil.copy(crate, away / "a.zip")
    environment = {**os.environ, "HOME": str(home), "XDG_DATA_HOME": str(home / "data"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "frictrack", "reproduce", "a.zip", "-o", "again", "--json"]
    ended = subprocess.run(command, cwd=away, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    assert found["equal"]
    assert found["same_platform"]
    assert found["tolerance"] == 0.0
    assert found["altered"] == []
    assert found["numbers"] > 10_000
    assert found["largest_difference"] == 0.0
    groups = {(one["file"], one["group"]) for one in found["groups"]}
    assert groups >= {
        ("study.h5", "models/1_coulomb+viscous"),
        ("study.h5", "models/2_coulomb+viscous+slope"),
        ("fast.h5", "motion"),
    }
    again = away / "again" / "study" / "study.toml"
    assert 'table = "inputs/1/fast.csv"   # of another day' in again.read_text()
    assert json.loads(store.read(again.parent / "study_results" / "study.h5", "diagnosis")["summary"])["alpha"] == 0.005


def test_a_changed_number_is_found_and_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folder / "study_results" / "fast.h5"
    friction: Friction = store.read(path, "friction", Friction)
    before = friction.F[7]
    friction.F.flags.writeable = True
    friction.F[7] *= 1 + 1e-6
    store.write(path, {"friction": GroupContent(friction, store.provenance(path, "friction") or store.Provenance())})
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", str(folder), "-o", "again", "--json"])
    out, err = capsys.readouterr()
    assert ended.value.code == 1
    assert "1 value(s) differ" in err
    found = json.loads(out)
    (group,) = [one for one in found["groups"] if not one["equal"]]
    assert (group["file"], group["group"], group["n_differences"]) == ("fast.h5", "friction", 1)
    (difference,) = group["differences"]
    assert difference["value"] == "F"
    assert difference["computed"] == before
    assert difference["stored"] == pytest.approx(before * (1 + 1e-6), rel=1e-12)
    assert found["altered"] == ["study_results/fast.h5"]
    assert found["same_conclusions"]


def test_conclusions_are_models_verdicts_parameters_and_errors() -> None:
    for name, concludes in {
        "summary.parameters.coulomb.F_c.value": True,
        "summary.errors.rms_displacement_um": True,
        "diagnosis.summary.verdict": True,
        "diagnosis.summary.missing[]": True,
        "diagnosis.summary.candidates[].effect": False,
        "curves.000_a.F_model": False,
    }.items():
        (group,) = compare_files({"a.h5": {"g": {name: [1.0]}}}, {"a.h5": {"g": {name: [2.0]}}}, exact=False)
        assert group["n_differences"] == 1
        assert group["same_conclusions"] is not concludes, name


def refused(*arguments: Any, **keywords: Any) -> str:
    with pytest.raises(FrictrackError) as raised:
        reproduce_crate(*arguments, **keywords)
    return str(raised.value)


@pytest.mark.slow
def test_large_films_are_described_by_their_hash(
    tmp_path: Path, sample_study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(payload, "MAX_INCLUDED_BYTES", 1_000_000)  # the film has 1.6 MB
    films = sample_study.parent
    session = Session(open_study(sample_study))
    made = write_crate(session, tmp_path / "crate")
    assert [one["file"] for one in made["by_hash"]] == ["fast.avi"]
    assert made["not_given"] == ["license", "author"]
    (film,) = [one for one in read_crate(tmp_path / "crate").inputs if not one.is_included]
    assert (film.place, film.size) == ("fast.avi", (films / "fast.avi").stat().st_size)
    said = refused(tmp_path / "crate", tmp_path / "a")
    assert said.startswith("expected the inputs of the study but fast.avi is not in the crate; give --recordings")
    assert not (tmp_path / "a").exists()
    other = tmp_path / "other" / "deep"
    other.mkdir(parents=True)
    (other / "fast.avi").write_bytes((films / "fast.avi").read_bytes()[:-1] + b"?")
    said = refused(tmp_path / "crate", tmp_path / "b", other.parent)
    assert f"fast.avi (found as {other / 'fast.avi'}) has other bytes than the crate says" in said
    (tmp_path / "other" / "again").mkdir()
    shutil.copy(films / "fast.avi", tmp_path / "other" / "again")
    found = reproduce_crate(tmp_path / "crate", tmp_path / "c", other.parent)  # the right one of two
    assert found["equal"]
    assert found["numbers"] > 50_000
    whole = write_crate(session, tmp_path / "whole.zip", CrateOptions(include_recordings=True))
    assert whole["by_hash"] == []
    assert "fast.avi" in whole["included"]


@pytest.fixture
def sample_study(tmp_path: Path) -> Path:
    """One film of the sample, of which only the simplest law is asked."""
    from frictrack.samples import copy_films  # noqa: PLC0415

    copy_films(tmp_path / "films")
    path = tmp_path / "films" / "study.toml"
    head = path.read_text().partition("[[run]]")[0].replace('"tustin"', '["coulomb", "viscous"]')
    path.write_text(head + '[[run]]\nvideo = "fast.avi"\n')
    return path


def test_recordings_of_several_files_keep_together(tmp_path: Path) -> None:
    """A header with its frames, a folder of pictures, and two folders of one name outside that of the study."""
    rng = np.random.default_rng(0)
    study, places = tmp_path / "lab" / "study", ("lab/study/films", "a/films", "b/films")
    for place in places:
        (tmp_path / place).mkdir(parents=True)
        write_photron(tmp_path / place, rng.integers(0, 255, (3, 16, 16), np.uint8), 8)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number in range(3):
        tifffile.imwrite(pictures / f"{number:03d}.tif", rng.integers(0, 255, (16, 16), np.uint8))
    (pictures / "notes.txt").write_text("no frame")
    videos = ("films/film.cih", "../../a/films/film.cih", "../../b/films/film.mraw", "../../pictures")
    runs = [f'[[run]]\nname = "{i}"\nvideo = "{video}"\n' for i, video in enumerate(videos)]
    head = '[study]\nmass = 0.35\n[camera]\nfps = 1000\nscale = "0.5 mm/px"\n'
    (study / "study.toml").write_text(head + "".join(runs))
    found = payload.list_payload(Session(open_study(study)), include_recordings=False)
    assert [part.place for part in found.parts] == [
        *("study.toml", "films/film.cih", "films/film.mraw", "inputs/1/film.cih", "inputs/1/film.mraw"),
        *("inputs/2/film.cih", "inputs/2/film.mraw"),
        *("inputs/3/pictures/000.tif", "inputs/3/pictures/001.tif", "inputs/3/pictures/002.tif"),
    ]
    assert found.moved == {
        "../../a/films/film.cih": "inputs/1/film.cih",
        "../../b/films/film.mraw": "inputs/2/film.mraw",
        "../../pictures": "inputs/3/pictures",
    }
    described = {part.place: part.source for part in found.parts}
    assert described["inputs/2/film.mraw"] == tmp_path / "b" / "films" / "film.mraw"


def test_results_that_frictrack_did_not_write_are_refused(folder: Path, tmp_path: Path) -> None:
    path = folder / "study_results" / "study.h5"
    kept = path.read_bytes()
    for wrong in ("{}", "[1]", "no JSON", '{"base": 1}'):
        store.write(path, {}, attribute_updates={"models/2_coulomb+viscous+slope": {"settings": wrong}})
        assert f"{path} is damaged" in refused(folder, tmp_path / f"again {len(wrong)}")
        path.write_bytes(kept)
    store.write(path, {}, attribute_updates={"models/2_coulomb+viscous+slope": {"deep": "[" * 7000 + "]" * 7000}})
    with pytest.raises(FrictrackError, match="is damaged"):
        stored_values(path)
    path.write_bytes(kept)
    path.write_bytes(kept[:-100])
    assert "is damaged" in refused(folder, tmp_path / "again")


def test_inputs_with_other_bytes_are_refused(folder: Path, tmp_path: Path) -> None:
    table = folder / "tables" / "slow.csv"
    table.write_bytes(table.read_bytes().replace(b"5", b"6", 1))
    said = refused(folder, tmp_path / "again")
    assert said.startswith("expected the inputs of the study but tables/slow.csv has other bytes than the crate says")


@pytest.mark.parametrize("name", ["../evil.txt", "/evil.txt", "a/../../evil.txt", "..\\evil.txt", "c:evil.txt", "a\n"])
def test_a_path_that_leads_out_is_refused(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr("study.toml", "")
        file.writestr(name, "x")
    said = refused(tmp_path / "a.zip", tmp_path / "inside" / "out")
    assert said.startswith("expected an RO-Crate but")
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.name != "a.zip"]


def test_bombs_and_damaged_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("zeros", bytes(4_000_000))
    monkeypatch.setattr("frictrack.flow.crate.payload.MAX_UNPACKED_BYTES", 1_000_000)
    assert "unpack to" in refused(tmp_path / "bomb.zip", tmp_path / "1")
    with zipfile.ZipFile(tmp_path / "twin.zip", "w") as file:
        file.writestr("a", "1")
        file.writestr("A", "2")
        info = zipfile.ZipInfo("link")
        info.external_attr = 0o120777 << 16
        file.writestr(info, "/etc/passwd")
    (tmp_path / "3").mkdir()
    unpack(tmp_path / "twin.zip", tmp_path / "3")
    assert not any(path.is_symlink() for path in (tmp_path / "3").iterdir())
    (tmp_path / "text.zip").write_text("no zip")
    assert "damaged or is not a zip file" in refused(tmp_path / "text.zip", tmp_path / "4")
    nameless = bytearray((tmp_path / "bomb.zip").read_bytes())
    at = nameless.index(b"PK\1\2")
    nameless[at + 28 : at + 32] = b"\0\0\5\0"  # the five letters of the name as other data
    (tmp_path / "nameless.zip").write_bytes(nameless)
    assert "damaged" in refused(tmp_path / "nameless.zip", tmp_path / "6")
    whole = bytearray((tmp_path / "twin.zip").read_bytes())
    whole[31] ^= 1  # the first byte of content
    (tmp_path / "flip.zip").write_bytes(whole.replace(b"\x01\x00A", b"\x01\x00B").replace(b"A", b"C"))
    assert "damaged" in refused(tmp_path / "flip.zip", tmp_path / "5")


def test_metadata_that_lead_out_or_are_of_others_are_refused(folder: Path, tmp_path: Path) -> None:
    raw = metadata(folder)
    path = folder / "ro-crate-metadata.json"
    path.write_text(json.dumps(raw).replace("inputs/1/fast.csv", "../../fast.csv"))
    assert refused(folder, tmp_path / "1").startswith("expected the path of a file inside a crate")
    for graph in ([], [{"@id": "./", "@type": "Dataset"}], "text", [1]):
        path.write_text(json.dumps({"@graph": graph}))
        assert refused(folder, tmp_path / "2").startswith("expected a crate of `frictrack export --to crate`")
    path.write_text("[" * 100_000)
    assert "cannot be read" in refused(folder, tmp_path / "3")
    path.unlink()
    assert refused(folder, tmp_path / "4").startswith("expected an RO-Crate but")


def rewrite_study(folder: Path, old: str, new: str) -> None:
    """Change the study file of a crate, and its description with it, as somebody who means harm would."""
    raw = metadata(folder)
    path = folder / "study.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    (entity,) = [one for one in raw["@graph"] if one["@id"] == "study.toml"]
    entity |= {"contentSize": str(path.stat().st_size), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    (folder / "ro-crate-metadata.json").write_text(json.dumps(raw))


@pytest.mark.parametrize(
    "named",
    [
        'table = "{outside}"',
        'table = "../slow.csv"',
        'table = "unlisted.csv"',
        'table = "file://{outside}"',
        'table = "ftp://127.0.0.1/slow.csv"',
        'table = "http://127.0.0.1/slow.csv"',
        'table = "tables/slow.csv"\nsensor = "{outside}"',
        'table = "tables/slow.csv"\ndrive = {{table = "{outside}"}}',
        'table = "tables/slow.csv"\nlens = "{outside}"',
        'table = "tables/slow.csv"\nscale = {{board = ["{outside}"], squares = [3, 4], square = "1 mm"}}',
    ],
)
def test_a_crate_names_only_what_it_lists(folder: Path, tmp_path: Path, named: str) -> None:
    outside = tmp_path / "slow.csv"
    shutil.copy(folder / "tables" / "slow.csv", outside)
    shutil.copy(outside, folder / "unlisted.csv")
    rewrite_study(folder, 'table = "tables/slow.csv"', named.format(outside=outside))
    said = refused(folder, tmp_path / "out", allow_addresses=True)
    assert "expected a file that the crate lists, in its own folder, but got" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", ["tables/slow.csv", "study.toml", "ro-crate-metadata.json"])
def test_links_out_of_a_crate_are_not_followed(folder: Path, tmp_path: Path, place: str) -> None:
    outside = tmp_path / "outside"
    (folder / place).rename(outside)
    (folder / place).symlink_to(outside)
    assert refused(folder, tmp_path / "out").startswith(f"expected {place} inside {folder} but it is a link out of it")


def test_addresses_of_a_crate_are_fetched_only_if_the_user_allows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    for name in ("crate", "web"):
        (tmp_path / name).mkdir()
    (tmp_path / "crate" / "study.toml").write_bytes(b"[study]")
    (tmp_path / "web" / "v3.csv").write_bytes(b"1,2")

    def described(place: str, content: bytes, *, is_included: bool) -> payload.Part:
        source, digest = tmp_path / "crate" / place, hashlib.sha256(content).hexdigest()
        return payload.Part(source, place, "input", len(content), digest, is_included=is_included)

    with serving(tmp_path / "web") as server:
        url = server.url("v3.csv")
        film = described("inputs/1/v3.csv", b"1,2", is_included=False)
        study = described("study.toml", b"[study]", is_included=True)
        crate = Crate(study, (film,), (), {url: film.place}, {})
        with pytest.raises(FrictrackError, match=f"give --recordings .*, or --allow-addresses to fetch {url}"):
            find_inputs(crate, None, None)
        assert server.requests == 0
        shown: list[str] = []
        found = find_inputs(crate, None, lambda done, total, what: shown.append(what))
        assert found[film.place].read_bytes() == b"1,2"
        assert shown == [f"fetching {url}"]
        here = replace(crate, moved={f"file://{tmp_path}/web/v3.csv": film.place})  # nobody asked for local files
        with pytest.raises(FrictrackError, match=r"inputs/1/v3\.csv is not in the crate"):
            find_inputs(here, None, lambda done, total, what: None)
        (tmp_path / "web" / "v3.csv").write_bytes(b"9,9")
        with pytest.raises(FrictrackError, match=r"v3\.csv .* has other bytes than the crate says"):
            find_inputs(crate, None, lambda done, total, what: None)


@pytest.mark.parametrize("protocol", ["", "file://"])
def test_paths_inside_the_study_are_relative_in_a_crate(tmp_path: Path, protocol: str) -> None:
    folder = tmp_path / "lab"
    write_table(folder / "slow.csv", 1.0, 1)
    (folder / "study.toml").write_text(f'[study]\nmass = 0.5\n[[run]]\ntable = "{protocol}{folder / "slow.csv"}"\n')
    listed = payload.list_payload(Session(open_study(folder)), include_recordings=False)
    assert listed.moved == {f"{protocol}{folder / 'slow.csv'}": "slow.csv"}


def test_nothing_is_overwritten(crate: Path, study: Path, tmp_path: Path) -> None:
    assert "exists; choose another" in refused(crate, tmp_path)
    assert "there is no nothing.zip" in refused(Path("nothing.zip"), tmp_path / "out")
    with pytest.raises(FrictrackError, match="exists; choose another name"):
        write_crate(Session(open_study(study)), tmp_path)


def test_authors_and_licences() -> None:
    found = read_authorship(["Ada <https://orcid.org/0000-0002-1694-233X>"], "https://example.org/licence")
    assert found.authors[0] == {"@id": "https://orcid.org/0000-0002-1694-233X", "@type": "Person", "name": "Ada"}
    assert found.licence is not None
    assert found.licence["@id"] == "https://example.org/licence"
    for wrong in ("Ada <0000-0002-1694-2330>", "<0000-0002-1694-233X>", "Ada <me@example.org>", ""):
        with pytest.raises(FrictrackError, match="expected an author as"):
            read_authorship([wrong])
    with pytest.raises(FrictrackError, match="expected a licence as an SPDX identifier"):
        read_authorship(licence="do what you like")


def test_safe_places() -> None:
    for good in ("study.toml", "films/[v3] µ&1.avi", "r/.frictrack/log.jsonl", "frames/0001.tif"):
        assert safe_place(good) == good
    for bad in ("", ".", "..", "a/..", "/a", "a\\b", "a:b", "a\0", "a.", "a ", 'a"', "x" * 300):
        with pytest.raises(FrictrackError, match="expected the path of a file inside a crate"):
            safe_place(bad)


def test_comparison_by_the_largest_magnitude() -> None:
    def differ(old: Any, new: Any, *, exact: bool) -> int:
        files = ({"a.h5": {"g": {"x": old}}}, {"a.h5": {"g": {"x": new}}})
        return sum(one["n_differences"] for one in compare_files(*files, exact=exact))

    near = [np.array([1e-12, 5.0])], [np.array([1e-12 + 4e-9, 5.0])]
    assert differ(*near, exact=True) == 1
    assert differ(*near, exact=False) == 0
    assert differ([5.0], [5.0 + 6e-9], exact=False) == 1
    assert differ([np.nan, None, np.inf], [np.nan, None, np.inf], exact=True) == 0
    for old, new in (([np.nan], [1.0]), ([np.inf], [-np.inf]), ([1.0], [1.0, 2.0]), (["a"], ["b"]), ([0.0], [1e-300])):
        assert differ(old, new, exact=False) == 1, (old, new)
    groups = compare_files({"a.h5": {"old": {}}}, {"a.h5": {"new": {}}}, exact=True)
    assert [(one["group"], *(one["differences"][0][key] for key in ("stored", "computed"))) for one in groups] == [
        ("old", "there", "missing"),
        ("new", "missing", "there"),
    ]


def test_only_uncertainties_and_misfits_are_compared_to_fewer_digits() -> None:
    names = {
        "summary.parameters.coulomb.F_c.value": 1e-9,
        "summary.parameters.coulomb.F_c.std": 1e-5,
        "sigma_a_y": 1e-5,
        "summary.errors.reduced_chi2": 1e-9,
        "diagnosis.summary.candidates[].delta_bic": 1e-9,
        "diagnosis.summary.detection_limits.texture.value": 1e-2,
        "diagnosis.figures.texture.limit": 1e-2,
        "diagnosis.figures.common_x.F": 1e-5,
        "F_model": 1e-9,
    }
    assert {name: tolerance_of(name) for name in names} == names


@pytest.mark.few(5)
@pytest.mark.parametrize(
    "unit", sorted({p["unit"] for one in effects.catalogue() for p in one["parameters"] if ucum(p["unit"])})
)
def test_ucum_codes_mean_the_same_unit(unit: str) -> None:
    """Pint reads UCUM after small changes: a point multiplies, a number behind a unit is its power."""
    import re  # noqa: PLC0415

    import pint  # noqa: PLC0415 - half a second

    registry = pint.UnitRegistry(cache_folder=None)
    ours = re.sub(r"\bpx\b", "1", unit).replace("%", "percent")
    ours = re.sub(r"(?<=[A-Za-z]) (?=[A-Za-z])", "*", ours)
    theirs = re.sub(r"\{\w+\}", "1", ucum(unit)).replace(".", "*").replace("%", "percent")
    theirs = re.sub(r"([A-Za-z])(-?\d)", r"\1**\2", theirs)
    assert registry.Quantity(1, ours).to_base_units() == registry.Quantity(1, theirs).to_base_units()
