"""Read who made a study and under which licence it is published, as RO-Crate describes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from frictrack.errors import FrictrackError

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
