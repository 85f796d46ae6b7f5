"""Look up the words of the project in `glossary.md`, which is also a page of the documentation."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files

MAX_NEAR = 5  # words that are offered for an unknown one


@dataclass(frozen=True)
class GlossaryEntry:
    """One line of the glossary."""

    words: tuple[str, ...]  # the word, then other names of the same
    meaning: str  # what it means, in one sentence
    on_hover: bool  # whether the page and the report explain it where it stands; bold in the glossary


@cache
def terms() -> tuple[GlossaryEntry, ...]:
    """Read all words.

    Examples
    --------
    >>> next(term.words for term in terms() if term.on_hover)
    ('free section',)

    """
    text = files("frictrack").joinpath("base", "glossary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \| (.+) \|$", text, re.MULTILINE)
    return tuple(
        GlossaryEntry(
            tuple(word.replace("*", "").split(", ")), re.sub(r"\[(.+?)\]\(.+?\)|`", r"\1", meaning), "**" in word
        )
        for word, meaning in rows
        if word != "word" and not word.startswith("---")
    )


def find_terms(word: str) -> list[GlossaryEntry]:
    """Find the lines of the glossary with a word; case, hyphens and a plural do not matter."""
    asked = _plain(word)
    return [term for term in terms() if asked in map(_plain, term.words)]


def near_words(word: str, others: Iterable[str] = ()) -> list[str]:
    """Offer words of the glossary, and other ones, that are written like a word or contain it.

    Examples
    --------
    >>> near_words("chi-square")[0], near_words("locking"), near_words("patsh", ["patch"])
    ('reduced chi-squared', ['peak locking'], ['patch'])

    """
    known = {_plain(name): name for name in (*(word for term in terms() for word in term.words), *others)}
    asked = _plain(word)
    inside = [key for key in known if asked and f" {asked}" in f" {key}"]
    near = get_close_matches(asked, known, MAX_NEAR, 0.7)
    return [known[key] for key in dict.fromkeys((*inside, *near))][:MAX_NEAR]


def symbols_in(equation: str, parameters: Container[str] = ()) -> str:
    """Explain the symbols of an equation that are no parameters, in one line.

    Examples
    --------
    >>> symbols_in("F_c s")
    's: direction of motion: +1 toward +x, −1 toward −x'

    """
    letters = [term for term in terms() if len(term.words[0]) == 1]
    known = [term for term in letters if term.words[0] not in parameters]
    used = [term for term in known if re.search(rf"(?<![\w,]){term.words[0]}(?![\w,])", equation)]
    return "; ".join(f"{term.words[0]}: {term.meaning.replace('; ', ', ')}" for term in used)


@cache
def hover_words() -> dict[str, str]:
    """Return the words, in lower case, that are explained where they stand, with their meanings; the longest first."""
    found = {word.lower(): term.meaning for term in terms() if term.on_hover for word in term.words}
    return dict(sorted(found.items(), key=lambda pair: -len(pair[0])))


@cache
def hover_pattern() -> re.Pattern[str]:
    """Return the pattern of `hover_words` in a text, also with a capital or as a plural."""
    return re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, hover_words()))})s?(?![\w-])", re.IGNORECASE)


def meaning_of(found: str) -> str:
    """Return the meaning of a match of `hover_pattern`."""
    word = found.lower()
    return hover_words().get(word) or hover_words()[word.removesuffix("s")]


def _plain(word: str) -> str:
    """Return a word in lower case, without hyphens, doubled spaces and the s of a plural."""
    spaced = " ".join(re.sub(r"[-_]", " ", word).lower().split())
    return spaced[:-1] if len(spaced) > 3 and spaced.endswith("s") and not spaced.endswith("ss") else spaced
