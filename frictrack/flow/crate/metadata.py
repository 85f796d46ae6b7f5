"""Describe a crate in JSON-LD: RO-Crate 1.1 with the profile of a process run.

References
----------
RO-Crate Metadata Specification 1.1, https://w3id.org/ro/crate/1.1.
Process Run Crate 0.5, https://w3id.org/ro/wfrun/process/0.5.
Farrell et al. (2013), Naming things with hashes, RFC 6920, for files that the crate does not contain.

"""

from __future__ import annotations

import base64
import csv
import io
import mimetypes
import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from urllib.parse import quote

from frictrack.base.errors import FrictrackError
from frictrack.base.version import __version__
from frictrack.flow.crate.payload import Part, Payload
from frictrack.results import Results

ORCID = "https://orcid.org/"
SPDX = "https://spdx.org/licenses/"
_AUTHOR = re.compile(r"\s*([^<>]*?)\s*(?:<\s*(?:https?://orcid\.org/)?([^<>\s]*)\s*>)?\s*")
_ORCID = re.compile(r"(?:\d{4}-){3}\d{3}[\dX]")
_SPDX = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{1,60}")
_ADDRESS = re.compile(r"https?://[^\s<>\"]+")

Entity = dict[str, Any]
"""One object of the metadata, with "@id" and "@type"."""


@dataclass(frozen=True)
class Authorship:
    """Authors and licence of a crate, as entities.

    Attributes
    ----------
    authors
        Persons; empty if none was named.
    licence
        The licence; None if none was named.

    """

    authors: tuple[Entity, ...] = ()
    licence: Entity | None = None
    not_given: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        lacks = {"license": self.licence is None, "author": not self.authors}
        object.__setattr__(self, "not_given", tuple(name for name, lacking in lacks.items() if lacking))


def read_authorship(authors: Sequence[str] = (), licence: str | None = None) -> Authorship:
    """Read authors and licence as a user writes them.

    Parameters
    ----------
    authors
        Names, each perhaps with an ORCID: ``"Ada Lovelace <0000-0002-1825-0097>"``.
    licence
        An identifier of SPDX, such as ``"CC-BY-4.0"``, or the address of a licence.

    Raises
    ------
    FrictrackError
        (usage) If an ORCID or the licence is none.

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
        raise FrictrackError(
            f'expected an author as "Name" or "Name <0000-0002-1825-0097>" with a valid ORCID but got "{text}"',
            usage=True,
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
        raise FrictrackError(
            f'expected a licence as an SPDX identifier such as CC-BY-4.0, or as an address, but got "{text}"',
            usage=True,
        )
    return {"@id": f"{SPDX}{text}", "@type": "CreativeWork", "name": text}


QUDT = "http://qudt.org/vocab/unit/"


@dataclass(frozen=True)
class UnitCode:
    """The codes of a unit.

    Attributes
    ----------
    ucum
        Code in UCUM; "" where a unit has none, because its powers are themselves fitted.
    qudt
        Name in the QUDT vocabulary; "" where QUDT has no such unit.

    """

    ucum: str
    qudt: str = ""

    @property
    def address(self) -> str:
        """Address of the unit in QUDT; its UCUM code after ``ucum:`` where QUDT does not have it."""
        if self.qudt:
            return QUDT + self.qudt
        return f"ucum:{self.ucum}" if self.ucum else ""


UNIT_CODES = {
    "1": UnitCode("1", "UNITLESS"),
    "%": UnitCode("%", "PERCENT"),
    "1/m": UnitCode("m-1", "PER-M"),
    "1/m^2": UnitCode("m-2", "PER-M2"),
    "1/s": UnitCode("s-1", "PER-SEC"),
    "Hz": UnitCode("Hz", "HZ"),
    "N": UnitCode("N", "N"),
    "N (s/m)^n": UnitCode(""),  # n is a parameter
    "N s": UnitCode("N.s", "N-SEC"),
    "N s/m": UnitCode("N.s/m", "N-SEC-PER-M"),
    "N s^2/m^2": UnitCode("N.s2/m2", "KiloGM-PER-M"),  # the same unit: N s²/m² = kg/m
    "N/m": UnitCode("N/m", "N-PER-M"),
    "N/s": UnitCode("N/s"),
    "g": UnitCode("g", "GM"),
    "kg": UnitCode("kg", "KiloGM"),
    "m": UnitCode("m", "M"),
    "m/s": UnitCode("m/s", "M-PER-SEC"),
    "m/s^2": UnitCode("m/s2", "M-PER-SEC2"),
    "ms": UnitCode("ms", "MilliSEC"),
    "px": UnitCode("{pixel}"),  # an annotation: UCUM counts pixels as 1
    "rad": UnitCode("rad", "RAD"),
    "s": UnitCode("s", "SEC"),
    "s/m": UnitCode("s/m"),
    "um": UnitCode("um", "MicroM"),
}  # by the unit as frictrack writes it


def unit_code(unit: str) -> UnitCode:
    """Return the codes of a unit; empty codes for one that a user's own effect brings in.

    Parameters
    ----------
    unit
        The unit, such as ``"N s/m"``.

    Examples
    --------
    >>> unit_code("N s/m").ucum, unit_code("N s/m").address
    ('N.s/m', 'http://qudt.org/vocab/unit/N-SEC-PER-M')

    """
    return UNIT_CODES.get(unit, UnitCode(""))


PACKAGES = {"numpy": "numpy", "scipy": "scipy", "h5py": "h5py", "opencv": "opencv-python-headless"}
CPU_INFO = Path("/proc/cpuinfo")
FRICTRACK = "frictrack"
MACHINE = ("operating system", "processor")  # what is no software package


def platform_versions() -> dict[str, str]:
    """Return the versions by name: frictrack, python, the packages, BLAS, operating system, processor.

    The same versions give the same results bit for bit: BLAS chooses its kernels by the processor.

    Examples
    --------
    >>> sorted(platform_versions())[:3]
    ['blas', 'frictrack', 'h5py']

    """
    found = {FRICTRACK: __version__, "python": f"{platform.python_implementation()} {platform.python_version()}"}
    found |= {name: _package_version(package) for name, package in PACKAGES.items()}
    return found | {"blas": _blas(), "operating system": _operating_system(), "processor": _processor()}


def _package_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # another distribution of the same module
        return "unknown"


def _blas() -> str:
    """Return the linear algebra that NumPy and SciPy were built with, and its kernels for this processor."""
    import numpy.linalg  # noqa: F401, PLC0415 - loads the library that is asked for
    import scipy.linalg  # noqa: F401, PLC0415
    from threadpoolctl import threadpool_info  # noqa: PLC0415 - as they

    libraries = [
        one for one in threadpool_info() if one["user_api"] == "blas" and not _is_of_opencv(str(one["filepath"]))
    ]
    names = [f"{one['internal_api']} {one['version']} {one.get('architecture', '')}".strip() for one in libraries]
    return ", ".join(sorted(set(names))) or "unknown"


def _is_of_opencv(path: str) -> bool:
    """Return whether a library is that of OpenCV, which is loaded only where a film is read."""
    return "opencv" in path


def _operating_system() -> str:
    library = " ".join(part for part in platform.libc_ver() if part)
    release = platform.mac_ver()[0] or (platform.release() if platform.system() == "Windows" else library)
    return f"{platform.system()} {release} {platform.machine()}"


def _processor() -> str:
    try:
        lines = CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine() or "unknown"


COVERAGE_FACTOR = 2  # of the expanded uncertainty: about 95 % of a normal distribution
TOTAL = "total"  # source of the last row of `frictrack.measure.error_budget`
PARAMETERS, BUDGET = "parameters.csv", "uncertainty_budget.csv"
PARAMETER_COLUMNS = (
    *("model", "current", "parameter", "value", "standard_uncertainty", "standard_uncertainty_misfit"),
    *("interval_low", "interval_high", "unit", "ucum", "qudt", "reason"),
)
BUDGET_COLUMNS = (
    *("run", "quantity", "estimate_N", "source", "input_standard_uncertainty", "input_unit", "input_ucum"),
    *("contribution_mean_N", "share_of_variance_mean", "contribution_frame_N", "share_of_variance_frame"),
    *("common_to", "known_from"),
)


def parameter_rows(results: Results) -> Iterator[dict[str, Any]]:
    """Yield one row per parameter of every model.

    Parameters
    ----------
    results
        Results of a study.

    """
    for model in results.models:
        for name, found in model.summary["parameters"].items():
            code = unit_code(found["unit"])
            low, high = found.get("interval") or (None, None)
            yield {
                "model": model.name,
                "current": model.current,
                "parameter": name,
                "value": found["value"],
                "standard_uncertainty": found["std"],
                "standard_uncertainty_misfit": found.get("std_misfit"),
                "interval_low": low,
                "interval_high": high,
                "unit": found["unit"],
                "ucum": code.ucum,
                "qudt": code.address,
                "reason": found["reason"],
            }


def budget_rows(results: Results) -> Iterator[dict[str, Any]]:
    """Yield the budget of every run: one row per source, then combined and expanded uncertainty; empty is unknown.

    Parameters
    ----------
    results
        Results of a study.

    """
    for run in results.runs:
        for row in run.budget.get("rows", ()):
            common = {"run": run.name, "quantity": "friction force", "estimate_N": run.budget["force_N"]}
            if row["source"] == TOTAL:
                yield common | {"source": "combined standard uncertainty"} | _contributions(row, 1)
                expanded = f"expanded uncertainty, k = {COVERAGE_FACTOR}"
                yield common | {"source": expanded} | _contributions(row, COVERAGE_FACTOR)
                continue
            yield (
                common
                | {
                    "source": row["source"],
                    "input_standard_uncertainty": row["size"],
                    "input_unit": row["unit"],
                    "input_ucum": unit_code(row["unit"]).ucum,
                    "share_of_variance_mean": row["share_mean"],
                    "share_of_variance_frame": row["share_frame"],
                    "common_to": row["common"],
                    "known_from": row["told"],
                }
                | _contributions(row, 1)
            )


def _contributions(row: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """Return the effect on the mean friction force and on the force of one frame, N."""
    parts = {"contribution_mean_N": row["mean_N"], "contribution_frame_N": row["frame_N"]}
    return {name: None if size is None else factor * size for name, size in parts.items()}


def table_files(results: Results) -> dict[str, bytes]:
    """Return the tables by file name, as CSV in UTF-8.

    Parameters
    ----------
    results
        Results of a study.

    """
    tables = {PARAMETERS: (PARAMETER_COLUMNS, parameter_rows(results)), BUDGET: (BUDGET_COLUMNS, budget_rows(results))}
    return {name: _csv(columns, rows) for name, (columns, rows) in tables.items()}


def _csv(columns: tuple[str, ...], rows: Iterator[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


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
