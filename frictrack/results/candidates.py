"""List the candidates of a diagnosis: one order and one wording for the terminal, the page, the report and figures.

Effects that were found come first, in the order found; each was tested in addition to those before it, and its rivals,
which predict the same data, follow it. Then come the effects that pass alone, then the others, both by their evidence.
The criterion is delta BIC throughout. A candidate without positive evidence is not listed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from frictrack.base.number_format import format_change, format_number, format_p_value, format_quantity, join_words

MAX_P = 0.005  # half of alpha = 0.01, the half that the candidates get
STANDINGS = {  # the words of every kind of candidate, for all that people read
    "named": "found",
    "lead": "explains a part",
    "rival": "predicts the same data as {}",
    "weaker": "passes alone",
    "less": "explains less than {}",
    "unconfirmed": "not confirmed by its fit",
    "fails": "not significant",
    "implausible": "not plausible: {}",
}
MAIN_KINDS = ("named", "rival", "lead")
ACTS_ON = {"force": "a force on the mass", "measurement": "an error of the measurement"}


@dataclass(frozen=True)
class CandidateRow:
    """One candidate.

    Attributes
    ----------
    effect : str
        Name of the effect.
    kind : {"named", "lead", "rival", "weaker", "fails", "implausible"}
        Found; explains a part of a misfit that nothing explains; predicts the same data as one that was found; passes
        with less evidence; explains less or is not significant; fits but is not plausible.
    standing : str
        The same in words, with what it was tested in addition to.
    delta_bic : float
        Evidence, above zero; positive means better with the effect.
    p : str
        p-value of the whole search, "at most 1/1000" where no simulated study reached the evidence.
    before, after, unit : float or None, float or None, str
        Held-out error without and with the effect, and its unit.
    added_to : tuple of str
        Effects found before, in addition to which it was tested.
    parameters : tuple of str
        Values that all runs share, with units.
    share : str
        Share of the misfit that it explains alone; "" if it is not known.
    source : mapping
        The candidate in the JSON of the diagnosis; its `words` say what it is, what it looks like, where it shows here,
        and how to confirm it.
    together : str
        The held-out error with the effects found after it, where it rises with this one alone; else "".

    """

    effect: str
    kind: str
    standing: str
    delta_bic: float
    p: str
    before: float | None
    after: float | None
    unit: str
    parameters: tuple[str, ...]
    added_to: tuple[str, ...]
    share: str
    source: Mapping[str, Any]
    together: str = ""

    @property
    def passes(self) -> bool:
        """Whether it is significant, improves the BIC, and is plausible."""
        return self.kind not in ("fails", "implausible")

    @property
    def evidence(self) -> str:
        """The p-value and delta BIC in words."""
        return f"p {self.p}, delta BIC {format_change(self.delta_bic)}"

    @property
    def numbers(self) -> list[str]:
        """The evidence, and the held-out error with what was held out."""
        how = " (whole runs)" if self.source.get("heldout") == "run" else ""
        return [self.evidence, *([f"{self.error}{how}"] if self.error else [])]

    @property
    def line(self) -> str:
        """Its parameters and numbers in one line."""
        return "; ".join(filter(None, (", ".join(self.parameters), self.evidence, self.error)))

    @property
    def error(self) -> str:
        """The held-out error in words, of frames where runs cannot be left out; "" if nothing was held out."""
        how = " (every other frame)" if self.source.get("heldout") == "frames" else ""
        return f"held-out error {self.held_out}{how}" if self.held_out else ""

    @property
    def rivals(self) -> list[str]:
        """Effects that these runs cannot distinguish from it."""
        return list(self.source["indistinguishable_from"]) if self.passes else []

    @property
    def acts_on(self) -> str:
        """Whether it is a force or an error of the measurement."""
        return ACTS_ON.get(self.source["acts_on"], "")

    @property
    def held_out(self) -> str:
        """Held-out error without and with it; "" if nothing was held out."""
        both = f"{format_number(self.before)} to {format_number(self.after)} {self.unit}{self.together}"
        return "" if self.before is None or self.after is None else both


def candidate_rows(diagnosis: Mapping[str, Any] | None) -> list[CandidateRow]:
    """List the candidates of a diagnosis, the best first.

    Parameters
    ----------
    diagnosis : mapping or None
        The JSON of a diagnosis; None before one was made.

    Examples
    --------
    >>> patch = {"effect": "patch", "p": 0.001, "delta_bic": 300.0, "passes": True, "indistinguishable_from": []}
    >>> drag = patch | {"effect": "drag", "delta_bic": 40.0}
    >>> for row in candidate_rows({"candidates": [drag, patch], "missing": ["patch", "drag"]}):
    ...     print(row.effect, "-", row.standing, "-", row.evidence)
    patch - found - p at most 1/1000, delta BIC +300
    drag - found in addition to patch - p at most 1/1000, delta BIC +40

    """
    if diagnosis is None:
        return []
    shares = {row["effect"]: row["explained_alone"] for row in diagnosis.get("importance") or []}
    by_name = {c["effect"]: c | {"share": shares.get(c["effect"])} for c in diagnosis["candidates"]}
    leads = diagnosis.get("leads") or []
    found = [name for name in (diagnosis.get("missing") or leads) if name in by_name]
    rows: dict[str, CandidateRow] = {}
    error = None  # held-out error with the effects found so far
    for k, name in enumerate(found):
        kind = "lead" if name in leads else "named"
        rows[name] = _row(by_name[name], kind, STANDINGS[kind], error, found[:k])
        error = rows[name].after if rows[name].after is not None else error
        for rival in by_name[name].get("indistinguishable_from") or []:
            if rival in by_name and rival not in found:
                rows.setdefault(rival, _row(by_name[rival], "rival", STANDINGS["rival"].format(name)))
    for k, name in enumerate(found):
        rows[name] = replace(rows[name], together=_together(rows[name], [rows[later] for later in found[k + 1 :]]))
    best = max((c for c in by_name.values() if passes(c)), key=lambda c: c["delta_bic"], default=None)
    others = (_other(c, best) for name, c in by_name.items() if name not in rows)
    rest = sorted(others, key=lambda row: (_OTHER_KINDS.index(row.kind), -row.delta_bic))
    return [*rows.values(), *(row for row in rest if row.delta_bic > 0)]


def _together(row: CandidateRow, later: Sequence[CandidateRow]) -> str:
    """Say which of the effects found later lower a held-out error that rises with one of them alone."""
    if row.before is None or row.after is None or row.after <= row.before:
        return ""
    for k, one in enumerate(later, 1):
        if one.after is not None and one.after < row.before:
            names = join_words([other.effect for other in later[:k]])
            return f" alone, but {format_number(one.after)} {row.unit} with {names} as well"
    return ""


def not_passing(rows: Sequence[CandidateRow]) -> str:
    """Count the candidates with positive evidence that do not pass, in words; "" if there are none."""
    failing, implausible = (sum(row.kind == kind for row in rows) for kind in ("fails", "implausible"))
    words = "explains less or is" if failing == 1 else "explain less or are"
    parts = [f"{failing} {words} not significant"] if failing else []
    parts += [f"{implausible} {'is' if implausible == 1 else 'are'} not plausible"] if implausible else []
    return f"Of the others with some evidence, {' and '.join(parts)}." if parts else ""


def passes(candidate: Mapping[str, Any]) -> bool:
    """Whether a candidate is significant for the whole search, confirmed by its simulated fit, and plausible.

    Parameters
    ----------
    candidate : mapping
        A candidate of a diagnosis: `passes`; in results of older versions `p`, `delta_bic` and, where it is not
        plausible, `implausible`.

    Examples
    --------
    >>> passes({"p": 0.001, "delta_bic": 40.0}), passes({"p": 0.2, "delta_bic": 40.0})
    (True, False)

    """
    if "passes" in candidate:
        return bool(candidate["passes"])
    return bool(candidate["p"] < MAX_P and candidate["delta_bic"] > 0 and not candidate.get("implausible"))


_OTHER_KINDS = ("weaker", "fails", "implausible")


def _other(c: Mapping[str, Any], best: Mapping[str, Any] | None) -> CandidateRow:
    """Row of a candidate that was not found and predicts other data."""
    if c.get("implausible"):
        return _row(c, "implausible", STANDINGS["implausible"].format(c["implausible"]))
    behind = best["delta_bic"] - c["delta_bic"] if best else 0.0
    if not passes(c):
        key = "fails" if c["p"] >= MAX_P else "less" if behind > 0 else "unconfirmed"
        return _row(c, "fails", STANDINGS[key].format(best["effect"] if best else ""))
    how = f", {format_number(behind)} behind the best" if behind >= 1 else ", level with the best" if behind > 0 else ""
    return _row(c, "weaker", STANDINGS["weaker"] + how)


def _row(
    c: Mapping[str, Any], kind: str, standing: str, before: float | None = None, added_to: Sequence[str] = ()
) -> CandidateRow:
    """Row of a candidate; `before` is the held-out error without it, if others were added before it."""
    added = f" in addition to {join_words(added_to)}" if added_to else ""
    unit = "N" if c.get("heldout_rms_after_um") is None else "um"
    bare, after = (c.get(f"heldout_rms_{when}_{unit}") for when in ("before", "after"))
    shared = {name: q for name, q in c.get("parameters", {}).items() if "[" not in name}
    own = sorted({name.partition("[")[0] for name in c.get("parameters", {}) if "[" in name})
    values = [f"{name} {format_quantity(q['value'], q['std'], q['unit'])}" for name, q in shared.items()]
    values += [f"one {' and one '.join(own)} per run"] if own else []
    if c["effect"].startswith("slope") and (here := c.get("words", {}).get("here")):
        values.append(here.partition(":")[0].lower())  # the incline is 0.4 degrees, not 0
    share = "" if c.get("share") is None else f"{100 * c['share']:.1f} %"
    return CandidateRow(
        c["effect"], kind, standing + added, c["delta_bic"], format_p_value(c["p"]),
        bare if before is None else before, after, unit.replace("u", "µ"), tuple(values), tuple(added_to), share, c,
    )  # fmt: skip
