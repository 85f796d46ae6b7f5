"""Describe a crate in JSON-LD: RO-Crate 1.1 with the profile of a process run.

References
----------
RO-Crate Metadata Specification 1.1, https://w3id.org/ro/crate/1.1.
Process Run Crate 0.5, https://w3id.org/ro/wfrun/process/0.5.
Farrell et al. (2013), Naming things with hashes, RFC 6920, for files that the crate does not contain.

"""

from __future__ import annotations

import base64
import mimetypes
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

from frictrack.crate.authorship import Authorship, Entity
from frictrack.crate.payload import Part, Payload
from frictrack.crate.platform_versions import FRICTRACK, MACHINE
from frictrack.crate.tables import parameter_rows
from frictrack.results import Results

METADATA = "ro-crate-metadata.json"
SPECIFICATION = "https://w3id.org/ro/crate/1.1"
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
CONTEXT = (
    f"{SPECIFICATION}/context",
    # newer than the context of version 1.1; the second is of RO-Crate 1.2
    {"sha256": "http://schema.org/sha256", "localPath": "https://w3id.org/ro/terms#localPath"},
)
MEDIA_TYPES = {
    ".toml": "application/toml",
    ".csv": "text/csv",
    ".h5": "application/x-hdf5",
    ".jsonl": "application/x-ndjson",
    ".avi": "video/x-msvideo",
}
OTHER_MEDIA_TYPE = "application/octet-stream"
UNCERTAINTIES = {  # columns of `tables`
    "standard_uncertainty": "standard uncertainty",
    "standard_uncertainty_misfit": "standard uncertainty that includes the effect of the missing force",
}
MOVED = "path in the study file"  # `propertyID` of where the crate has what the study file names otherwise
PYPI = "https://pypi.org/project"
ADDRESSES = {  # of software that is not on PyPI under its name; the version follows
    "python": "https://www.python.org/#",
    "opencv": f"{PYPI}/opencv-python-headless/",
    "blas": "https://www.netlib.org/blas/#",
}


@dataclass(frozen=True)
class Described:
    """What the metadata describe.

    Attributes
    ----------
    results
        Results of the study.
    payload
        The files.
    authorship
        Authors and licence.
    versions
        Versions of software and machine; see `platform_versions`.
    started, ended
        When the analysis began and ended, ISO 8601; None if not known.

    """

    results: Results
    payload: Payload
    authorship: Authorship
    versions: Mapping[str, str]
    started: str | None
    ended: str


def describe_crate(described: Described) -> dict[str, Any]:
    """Return the content of ``ro-crate-metadata.json``.

    Parameters
    ----------
    described
        What is in the crate.

    """
    files = [_file(part) for part in described.payload.parts]
    parameters = list(_parameters(described.results))
    moved = list(_moved(described.payload.moved))
    software = list(_software(described.versions))
    action = _action(described, moved, software[0])
    root = _root(described, files, [one for one in parameters if "propertyID" in one], action)
    descriptor = {
        "@id": METADATA,
        "@type": "CreativeWork",
        "conformsTo": {"@id": SPECIFICATION},
        "about": {"@id": "./"},
    }
    profile = {"@id": PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}
    people = [*described.authorship.authors, *([described.authorship.licence] if described.authorship.licence else [])]
    entities = [descriptor, root, profile, *people, *files, action, *moved, *software, *parameters]
    return {"@context": list(CONTEXT), "@graph": [_without_none(one) for one in _once(entities)]}


def _root(described: Described, files: Sequence[Entity], parameters: Sequence[Entity], action: Entity) -> Entity:
    results, authorship = described.results, described.authorship
    model = results.current
    law = "" if model is None else f" The current model is {model.equation}."
    verdict = "" if results.diagnosis is None else f" The verdict of the diagnosis is {results.diagnosis['verdict']}."
    runs = f"{len(results.runs)} run{'s' if len(results.runs) != 1 else ''}"
    return {
        "@id": "./",
        "@type": "Dataset",
        "name": results.name,
        "description": f"Friction law of a sliding mass, identified by frictrack from {runs}.{law}{verdict}",
        "datePublished": datetime.now(UTC).isoformat(timespec="seconds"),
        "conformsTo": {"@id": PROFILE},
        "license": _reference(authorship.licence),
        "author": _references(authorship.authors),
        "mainEntity": {"@id": files[0]["@id"]},
        "hasPart": _references(files),
        "mentions": _reference(action),
        "variableMeasured": _references(parameters),
    }


def file_address(part: Part) -> str:
    """Return the address of a file in the metadata: its path, or its hash if the crate does not contain it.

    Parameters
    ----------
    part
        The file.

    """
    if part.is_included:
        return quote(part.place)
    digest = base64.urlsafe_b64encode(bytes.fromhex(part.sha256)).decode().rstrip("=")
    return f"ni:///sha-256;{digest}?name={quote(part.place, safe='')}"


def _file(part: Part) -> Entity:
    suffix = part.source.suffix.lower()
    return {
        "@id": file_address(part),
        "@type": "File",
        "name": part.source.name,
        "contentSize": str(part.size),
        "sha256": part.sha256,
        "localPath": None if part.is_included else part.place,
        "encodingFormat": MEDIA_TYPES.get(suffix) or mimetypes.types_map.get(suffix, OTHER_MEDIA_TYPE),
    }


def _moved(moved: Mapping[str, str]) -> Iterator[Entity]:
    for number, (text, place) in enumerate(moved.items(), 1):
        yield {"@id": f"#path-{number}", "@type": "PropertyValue", "propertyID": MOVED, "name": text, "value": place}


def _software(versions: Mapping[str, str]) -> Iterator[Entity]:
    """Yield frictrack, then what it requires."""
    names = [name for name in versions if name not in MACHINE]
    required = [name for name in names if name != FRICTRACK]
    machine = dict(zip(("operatingSystem", "processorRequirements"), (versions[name] for name in MACHINE), strict=True))
    more = {"softwareRequirements": [{"@id": _software_address(name, versions[name])} for name in required]}
    for name in (FRICTRACK, *required):
        yield {
            "@id": _software_address(name, versions[name]),
            "@type": "SoftwareApplication",
            "name": name,
            "softwareVersion": versions[name],
            "url": _software_address(name, ""),
            **(machine | more if name == FRICTRACK else {}),
        }


def _software_address(name: str, version: str) -> str:
    address = ADDRESSES.get(name, f"{PYPI}/{name}/")
    return f"{address}{quote(version, safe='')}" if version else address.rstrip("#")


def _action(described: Described, moved: Sequence[Entity], software: Entity) -> Entity:
    parts = described.payload.parts
    inputs = [{"@id": file_address(part)} for part in parts if part.role != "result"]
    outputs = [{"@id": file_address(part)} for part in parts if part.role == "result"]
    name = described.results.name
    return {
        "@id": "#analysis",
        "@type": "CreateAction",
        "name": f"Analysis of {name} with frictrack",
        "description": f"frictrack run {parts[0].place}; the models tried are in the history of the results.",
        "instrument": _reference(software),
        "object": _unpacked([*inputs, *({"@id": one["@id"]} for one in moved)]),
        "result": _unpacked(outputs),
        "startTime": described.started,
        "endTime": described.ended,
        "agent": _references(described.authorship.authors),
        "actionStatus": "http://schema.org/CompletedActionStatus",
    }


def _parameters(results: Results) -> Iterator[Entity]:
    """Yield the parameters of all models: value, then standard uncertainty and interval where they are known."""
    for row in parameter_rows(results):
        address = quote(f"{row['model']}/{row['parameter']}")
        unit = {"unitText": row["ucum"] or row["unit"], "unitCode": row["qudt"] or None}
        number = {"@type": "PropertyValue", **unit}
        more: list[Entity] = []
        for key, name in UNCERTAINTIES.items():
            if row[key] is not None:
                more.append({"@id": f"#{key}/{address}", **number, "name": name, "value": row[key]})
        if row["interval_low"] is not None or row["interval_high"] is not None:
            limits = {"minValue": row["interval_low"], "maxValue": row["interval_high"]}
            more.append({"@id": f"#interval/{address}", **number, "name": "95 % interval", **limits})
        current = ", the current one" if row["current"] else ""
        reason = f"; {row['reason']}" if row["reason"] else ""
        yield {
            "@id": f"#parameter/{address}",
            **number,
            "name": row["parameter"],
            "propertyID": f"{row['model']}/{row['parameter']}",
            "description": f"parameter of the model {row['model']}{current}{reason}",
            "value": row["value"],
            "valueReference": _references(more),
        }
        yield from more


def _reference(entity: Entity | None) -> Entity | None:
    return None if entity is None else {"@id": entity["@id"]}


def _references(entities: Iterable[Entity]) -> Any:
    return _unpacked([{"@id": one["@id"]} for one in entities])


def _unpacked(values: Sequence[Entity]) -> Any:
    """Return a list; of one value, the value itself, and None of none, as the specification recommends."""
    return values if len(values) > 1 else next(iter(values), None)


def _once(entities: Iterable[Entity]) -> list[Entity]:
    """Return every entity once: an author who is named twice is one person."""
    return list({one["@id"]: one for one in entities}.values())


def _without_none(entity: Entity) -> Entity:
    return {key: value for key, value in entity.items() if value is not None}
