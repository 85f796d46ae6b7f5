"""Publish a study as one research object (RO-Crate), and compute the results of such a crate again elsewhere.

In Python, a crate is written from a session and reproduced in a new folder.

    from frictrack.flow.crate import CrateOptions, reproduce_crate, write_crate
    write_crate(Session(open_study("study.toml")), Path("study.crate.zip"), CrateOptions(licence="CC-BY-4.0"))
    reproduce_crate(Path("study.crate.zip"), Path("again"))["equal"]

    payload      what is in a crate: its files, tables and versions; open it safely
    reproducing  read it, find and check the recordings, compute its results again and compare them

The metadata that this module writes are JSON-LD: RO-Crate 1.1 with the profile of a process run.

References
----------
RO-Crate Metadata Specification 1.1, https://w3id.org/ro/crate/1.1.
Process Run Crate 0.5, https://w3id.org/ro/wfrun/process/0.5.
Farrell et al. (2013), Naming things with hashes, RFC 6920, for files that the crate does not contain.

"""

from __future__ import annotations

import base64
import json
import mimetypes
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from frictrack.base import imported
from frictrack.base.errors import UsageError, os_errors_as
from frictrack.base.files import atomic_write
from frictrack.flow import Session
from frictrack.flow.crate import payload
from frictrack.flow.crate.reproducing import reproduce_crate
from frictrack.results import Results

__all__ = ["CrateOptions", "reproduce_crate", "write_crate"]


ORCID = "https://orcid.org/"
SPDX = "https://spdx.org/licenses/"
_AUTHOR = re.compile(r"\s*([^<>]*?)\s*(?:<\s*(?:https?://orcid\.org/)?([^<>\s]*)\s*>)?\s*")
_ORCID = re.compile(r"(?:\d{4}-){3}\d{3}[\dX]")
_SPDX = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{1,60}")
_ADDRESS = re.compile(r"https?://[^\s<>\"]+")

Entity = dict[str, Any]
"""One object of the metadata, with "@id" and "@type"."""


class Authorship(NamedTuple):
    """Authors and licence of a crate, as entities; empty or None where none was named."""

    authors: tuple[Entity, ...] = ()
    licence: Entity | None = None


def read_authorship(authors: Sequence[str] = (), licence: str | None = None) -> Authorship:
    """Read authors and licence as a user writes them.

    Examples
    --------
    >>> read_authorship(["Ada Lovelace <0000-0002-1825-0097>"]).authors[0]["@id"]
    'https://orcid.org/0000-0002-1825-0097'

    """
    people = tuple(_person(text, number) for number, text in enumerate(authors, 1))
    return Authorship(people, None if licence is None else _licence(licence))


def _person(text: str, number: int) -> Entity:
    found = _AUTHOR.fullmatch(text)
    if found is None or not found[1] or (found[2] is not None and not is_orcid(found[2])):
        raise UsageError(
            f'expected an author as "Name" or "Name <0000-0002-1825-0097>" with a valid ORCID but got "{text}"'
        )
    address = f"{ORCID}{found[2]}" if found[2] else f"#author-{number}"
    return {"@id": address, "@type": "Person", "name": found[1]}


def is_orcid(text: str) -> bool:
    """Return whether a text is an ORCID: 16 characters of which the last is the check digit of ISO 7064, 11-2.

    Examples
    --------
    >>> is_orcid("0000-0002-1825-0097"), is_orcid("0000-0002-1825-0098")
    (True, False)

    """
    if not _ORCID.fullmatch(text):
        return False
    digits = text.replace("-", "")
    total = 0
    for digit in digits[:-1]:
        total = (total + int(digit)) * 2
    return digits[-1] == "0123456789X"[(12 - total % 11) % 11]


def _licence(text: str) -> Entity:
    if _ADDRESS.fullmatch(text):
        return {"@id": text, "@type": "CreativeWork", "name": text}
    if not _SPDX.fullmatch(text):
        raise UsageError(
            f'expected a licence as an SPDX identifier such as CC-BY-4.0, or as an address, but got "{text}"'
        )
    return {"@id": f"{SPDX}{text}", "@type": "CreativeWork", "name": text}


SPECIFICATION = "https://w3id.org/ro/crate/1.1"
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
CONTEXT = (
    f"{SPECIFICATION}/context",
    # newer than the context of version 1.1; the second is of RO-Crate 1.2
    {"sha256": "http://schema.org/sha256", "localPath": "https://w3id.org/ro/terms#localPath"},
)
MEDIA_TYPES = {".toml": "application/toml", ".jsonl": "application/x-ndjson"}  # which Python does not know
OTHER_MEDIA_TYPE = "application/octet-stream"
UNCERTAINTIES = {  # keys of a parameter in the JSON of a fit
    "std": "standard uncertainty",
    "std_misfit": "standard uncertainty that includes the effect of the missing force",
}
PYPI = "https://pypi.org/project"
ADDRESSES = {  # of software that is not on PyPI under its name; the version follows
    "python": "https://www.python.org/#",
    "opencv": f"{PYPI}/opencv-python-headless/",
    "blas": "https://www.netlib.org/blas/#",
}


class _Graph:
    """The entities of the metadata by their addresses."""

    def __init__(self) -> None:
        self.entities: dict[str, Entity] = {}

    def add(self, address: str, kind: str, **values: Any) -> Entity:
        """Add an entity, without values that are None; return the reference to it."""
        known = {key: value for key, value in values.items() if value is not None}
        self.entities[address] = {"@id": address, "@type": kind, **known}
        return {"@id": address}

    def add_all(self, entities: Iterable[Entity]) -> Any:
        """Add entities; return the references to them."""
        return _one_or_several(self.add(one["@id"], one["@type"], name=one["name"]) for one in entities)


def _one_or_several(references: Iterable[Entity]) -> Any:
    """Return a list of references; of one reference itself, and None of none, as the specification recommends."""
    found = list(references)
    return found if len(found) > 1 else next(iter(found), None)


def describe_crate(session: Session, results: Results, content: payload.Payload, authorship: Authorship) -> Entity:
    """Return the content of ``ro-crate-metadata.json``."""
    graph = _Graph()
    files = [(part.role, _add_file(graph, part)) for part in content.parts]
    moved = [
        graph.add(f"#path-{number}", "PropertyValue", propertyID=payload.MOVED, name=text, value=place)
        for number, (text, place) in enumerate(content.moved.items(), 1)
    ]
    authors = graph.add_all(authorship.authors)
    action = graph.add(
        "#analysis",
        "CreateAction",
        name=f"Analysis of {results.name} with frictrack",
        description=f"frictrack run {content.parts[0].place}; the models tried are in the history of the results.",
        instrument=_add_software(graph, payload.platform_versions()),
        object=_one_or_several([*(file for role, file in files if role != "result"), *moved]),
        result=_one_or_several(file for role, file in files if role == "result"),
        startTime=next((change.time for change in session.commands.changes), None),
        endTime=datetime.fromtimestamp(session.path.stat().st_mtime, UTC).isoformat(timespec="seconds"),
        agent=authors,
        actionStatus="http://schema.org/CompletedActionStatus",
    )
    law = "" if results.current is None else f" The current model is {results.current.equation}."
    verdict = "" if results.diagnosis is None else f" The verdict of the diagnosis is {results.diagnosis['verdict']}."
    runs = f"{len(results.runs)} run{'s' if len(results.runs) != 1 else ''}"
    root = graph.add(
        "./",
        "Dataset",
        name=results.name,
        description=f"Friction law of a sliding mass, identified by frictrack from {runs}.{law}{verdict}",
        datePublished=datetime.now(UTC).isoformat(timespec="seconds"),
        conformsTo=graph.add(PROFILE, "CreativeWork", name="Process Run Crate", version="0.5"),
        license=graph.add_all([authorship.licence] if authorship.licence else []),
        author=authors,
        mainEntity=files[0][1],
        hasPart=_one_or_several(file for _, file in files),
        mentions=action,
        variableMeasured=_one_or_several(_add_parameters(graph, results)),
    )
    graph.add(payload.METADATA, "CreativeWork", conformsTo={"@id": SPECIFICATION}, about=root)
    return {"@context": list(CONTEXT), "@graph": list(graph.entities.values())}


def file_address(part: payload.Part) -> str:
    """Return the address of a file in the metadata: its path, or its hash if the crate does not contain it."""
    if part.is_included:
        return quote(part.place)
    digest = base64.urlsafe_b64encode(bytes.fromhex(part.sha256)).decode().rstrip("=")
    return f"ni:///sha-256;{digest}?name={quote(part.place, safe='')}"


def _add_file(graph: _Graph, part: payload.Part) -> Entity:
    suffix = part.source.suffix.lower()
    return graph.add(
        file_address(part),
        "File",
        name=part.source.name,
        contentSize=str(part.size),
        sha256=part.sha256,
        localPath=None if part.is_included else part.place,
        encodingFormat=MEDIA_TYPES.get(suffix) or mimetypes.types_map.get(suffix, OTHER_MEDIA_TYPE),
    )


def _add_software(graph: _Graph, versions: Mapping[str, str]) -> Entity:
    """Add frictrack and what it requires; return the reference to frictrack."""

    def add(name: str, **more: Any) -> Entity:
        address, number = ADDRESSES.get(name, f"{PYPI}/{name}/"), versions[name]
        kind, url = "SoftwareApplication", address.rstrip("#")
        return graph.add(f"{address}{quote(number, safe='')}", kind, name=name, softwareVersion=number, url=url, **more)

    required = [add(name) for name in versions if name not in (payload.FRICTRACK, *payload.MACHINE)]
    keys = ("operatingSystem", "processorRequirements")
    machine = {key: versions[name] for key, name in zip(keys, payload.MACHINE, strict=True)}
    return add(payload.FRICTRACK, softwareRequirements=required, **machine)


def ucum(unit: str) -> str:
    """Return the UCUM code of a unit; empty where a power of it is a parameter.

    Examples
    --------
    >>> ucum("N s^2/m^2"), ucum("px"), ucum("N (s/m)^n")
    ('N.s2/m2', '{pixel}', '')

    """
    if "^n" in unit:
        return ""
    return "{pixel}" if unit == "px" else unit.replace("^", "").replace(" ", ".")


def _add_parameters(graph: _Graph, results: Results) -> Iterator[Entity]:
    """Add the parameters of all models with their standard uncertainties and intervals; yield the references."""
    kind = "PropertyValue"
    for model, (name, found) in ((m, item) for m in results.models for item in m.summary["parameters"].items()):
        address, code = quote(f"{model.name}/{name}"), ucum(found["unit"])
        unit = {"unitText": code or found["unit"], "unitCode": f"ucum:{code}" if code else None}
        more = [
            graph.add(f"#{key}/{address}", kind, **unit, name=words, value=found[key])
            for key, words in UNCERTAINTIES.items()
            if found.get(key) is not None
        ]
        low, high = found.get("interval") or (None, None)
        if (low, high) != (None, None):
            limits = {"minValue": low, "maxValue": high}
            more.append(graph.add(f"#interval/{address}", kind, **unit, name="95 % interval", **limits))
        current = ", the current one" if model.current else ""
        reason = f"; {found['reason']}" if found["reason"] else ""
        yield graph.add(
            f"#parameter/{address}",
            kind,
            **unit,
            name=name,
            propertyID=f"{model.name}/{name}",
            description=f"parameter of the model {model.name}{current}{reason}",
            value=found["value"],
            valueReference=_one_or_several(more),
        )


SUFFIX = ".crate.zip"
TABLES = "tables"  # folder among the results


@dataclass(frozen=True)
class CrateOptions:
    """What a user asks of a crate.

    Attributes
    ----------
    include_recordings
        Include films of any size.
    authors
        Names, each perhaps with an ORCID.
    licence
        Identifier of SPDX, or an address.

    """

    include_recordings: bool = False
    authors: Sequence[str] = ()
    licence: str | None = None


def write_crate(session: Session, path: Path | None = None, options: CrateOptions | None = None) -> dict[str, Any]:
    """Bring a study up to date and write its crate.

    Parameters
    ----------
    session
        The study.
    path
        The file, which ends in ``.zip``, or a new folder; None for ``<study>.crate.zip`` in the folder of the results.
    options
        What goes in; None for the defaults.

    Returns
    -------
    dict
        JSON of `frictrack export --to crate`.

    Raises
    ------
    FrictrackError
        If the study cannot be computed, a file cannot be read or written, or an author or licence is none.

    """
    options = options or CrateOptions()
    authorship = read_authorship(options.authors, options.licence)
    study = session.study
    target = study.output / f"{study.path.stem}{SUFFIX}" if path is None else path
    _check_target(target)
    session.report(anew=False)
    results = session.results()
    content = payload.list_payload(session, include_recordings=options.include_recordings)
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch)
        tables = imported("frictrack.present.export.tables:summary_tables")(results)
        for name, table in tables.items():
            table.to_csv(path := made / f"{name}.csv", index=False, lineterminator="\n")
            part = payload.Part.read(path, f"{content.results}/{TABLES}/{path.name}", "result")
            content = replace(content, parts=(*content.parts, part))
        metadata = describe_crate(session, results, content, authorship)
        text = json.dumps(metadata, indent=1, ensure_ascii=False, allow_nan=False)
        (made / payload.METADATA).write_text(text, encoding="utf-8")
        included = [part for part in content.parts if part.is_included]
        session.progress(0, 0, f"writing {target.name}")
        _write(target, [*included, payload.Part.read(made / payload.METADATA, payload.METADATA, "metadata")])
    return {
        "crate": str(target),
        "files": len(included) + 1,
        "bytes": target.stat().st_size if target.is_file() else sum(part.size for part in included),
        "included": [part.place for part in included],
        "by_hash": [
            {"file": one.place, "bytes": one.size, "sha256": one.sha256} for one in content.parts if not one.is_included
        ],
        "not_given": ["license"] * (authorship.licence is None) + ["author"] * (not authorship.authors),
        "output": str(target.parent),
    }


def _check_target(target: Path) -> None:
    """Raise FrictrackError (usage) if a folder exists that would be overwritten, before any work."""
    if target.suffix != ".zip" and target.exists():
        raise UsageError(
            f"expected the name of a new folder, or of a file that ends in .zip, but {target} exists; "
            "choose another name"
        )
    if target.is_dir():
        raise UsageError(f"expected the name of a zip file but {target} is a folder; choose another name")


def _write(target: Path, parts: Sequence[payload.Part]) -> None:
    """Write the files of a crate, which gets its name when it is complete."""
    if target.suffix == ".zip":
        with atomic_write(target) as unfinished, zipfile.ZipFile(unfinished, "w", strict_timestamps=False) as file:
            for part in parts:
                file.write(part.source, part.place, zipfile.ZIP_STORED if part.is_film else zipfile.ZIP_DEFLATED)
        return
    with os_errors_as(f"cannot write {target}"):
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}_", dir=target.parent) as scratch:
            folder = Path(scratch) / target.name
            for part in parts:
                path = folder / part.place
                path.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(part.source, path)
            os.replace(folder, target)
