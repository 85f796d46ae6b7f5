"""Describe the verdict of a diagnosis, in the same words on the terminal, the page and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from frictrack.base.number_format import format_change, format_plain, format_share, join_words
from frictrack.results.candidates import AXES, joined_name

VERDICTS = {  # the words of every verdict, for all that people read
    "complete": "{model} is complete: no further effect is detectable in these runs",
    "undetermined": "Undetermined: these runs do not determine {what}",
    "missing": "{model} lacks {what}",
    "ambiguous": "{model} lacks {what}: these runs cannot distinguish {unclear}",
    "unexplained": "{model} lacks something that no effect of the library explains",
}

MAX_GAPS_NAMED = 2  # in a verdict
MAX_EQUIVALENTS_NAMED = 4

NOT_SAID = [{"what": "the law", "why": "not determined", "settled_by": ""}]  # in results of older versions

CHECK_FIRST = "Check first:"  # heads every implausible number of a study, beside the number and above the verdict
CHECK_NEXT = 'Check these numbers first, or set `plausible = "checked"` in the study file.'  # what to do then

VERDICT_ONLY = (
    "Only the verdict is known so far, and it is final; `frictrack diagnose` computes where the model fails and the "
    "next experiments."
)


def describe_verdict(diagnosis: Mapping[str, Any], model: str) -> str:
    """Describe the verdict on a model and name the effects.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis: `verdict`, `missing`, `candidates`, `levels`, and `undetermined` for that verdict.
    model : str
        Name of the model in words.

    Returns
    -------
    str
        One sentence without a full stop.

    Examples
    --------
    >>> describe_verdict({"verdict": "missing", "missing": ["texture"], "candidates": []}, "Tustin")
    'Tustin lacks texture'
    >>> candidates = [{"effect": "texture"}, {"effect": "patch", "indistinguishable_from": ["spring"]}]
    >>> found = {"verdict": "ambiguous", "missing": ["texture", "patch"], "candidates": candidates}
    >>> describe_verdict(found, "Tustin")
    'Tustin lacks texture, and patch or spring: these runs cannot distinguish the last of them'
    >>> describe_verdict({"verdict": "complete", "missing": [], "levels": ["viscous.level"]}, "Tustin")
    'Tustin + viscous.level is complete: no further effect is detectable in these runs'

    """
    kind, what, unclear = diagnosis["verdict"], join_words(diagnosis["missing"]), "them"
    if kind == "undetermined":
        what = join_words([gap["what"] for gap in (diagnosis.get("undetermined") or NOT_SAID)[:MAX_GAPS_NAMED]])
    if kind == "ambiguous":
        certain, what = certain_effects(diagnosis), join_words(indistinguishable_effects(diagnosis), "or")
        what, unclear = (f"{join_words(certain)}, and {what}", "the last of them") if certain else (what, unclear)
    if kind == "complete":
        model = " + ".join([model, *(diagnosis.get("levels") or ())])
    said = VERDICTS[kind].format(model=model, what=what, unclear=unclear)
    return "; ".join([said, *(describe_leads(diagnosis) if kind == "unexplained" else ())])


def headline(diagnosis: Mapping[str, Any]) -> str:
    """Return the verdict in words, from the JSON of `frictrack diagnose` or of a diagnosis outside a study."""
    return diagnosis.get("headline") or describe_verdict(diagnosis, joined_name(diagnosis["model"]))


def describe_leads(diagnosis: Mapping[str, Any]) -> list[str]:
    """Say which effects explain a part of a misfit that none explains: leads, and no causes.

    Examples
    --------
    >>> describe_leads({"leads": ["patch", "drag"]})
    ['patch and drag explain a part of it: leads, no causes']

    """
    leads = diagnosis.get("leads") or []
    verb, kind = ("explains", "a lead, no cause") if len(leads) == 1 else ("explain", "leads, no causes")
    return [f"{join_words(leads)} {verb} a part of it: {kind}"] if leads else []


def certain_effects(diagnosis: Mapping[str, Any]) -> list[str]:
    """Select the missing effects that these runs distinguish from all others.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis.

    Examples
    --------
    >>> patch = {"effect": "patch", "indistinguishable_from": ["spring"]}
    >>> candidates = [{"effect": "texture", "indistinguishable_from": []}, patch]
    >>> certain_effects({"missing": ["texture", "patch"], "candidates": candidates})
    ['texture']

    """
    if sets := _sets_of_other_size(diagnosis):
        return [name for name in diagnosis["missing"] if all(name in one for one in sets)]
    rivals = _rivals(diagnosis)
    unclear = indistinguishable_effects(diagnosis)
    return [name for name in diagnosis["missing"] if not rivals.get(name) and name not in unclear]


def _sets_of_other_size(diagnosis: Mapping[str, Any]) -> list[list[str]]:
    """Sets of more or fewer effects that explain as much as the missing ones."""
    sets = [one["effects"] for one in diagnosis.get("alternatives") or []]
    return [one for one in sets if len(one) != len(diagnosis["missing"])]


def _rivals(diagnosis: Mapping[str, Any]) -> dict[str, list[str]]:
    return {c["effect"]: c.get("indistinguishable_from") or [] for c in diagnosis["candidates"]}


def indistinguishable_effects(diagnosis: Mapping[str, Any]) -> list[str]:
    """Select the first effect of a diagnosis that these runs cannot distinguish from others, and these; else the best.

    A formula that explains as much as all effects found is one of the others.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis with at least one missing effect or candidate.

    Returns
    -------
    list of str
        Names of the effects, the best first.

    Examples
    --------
    >>> found = {"missing": ["patch"], "candidates": [], "unexplained": {"rival": "a formula of place"}}
    >>> indistinguishable_effects(found | {"verdict": "ambiguous"})
    ['patch', 'a formula of place']
    >>> found = {"missing": ["asymmetry"], "candidates": [], "alternatives": [{"effects": ["slope", "viscous"]}]}
    >>> indistinguishable_effects(found | {"verdict": "ambiguous"})
    ['asymmetry', 'slope with viscous']

    """
    rivals, whole = _rivals(diagnosis), _formula_rival(diagnosis)
    names = diagnosis["missing"] or [diagnosis["candidates"][0]["effect"]]
    if sets := _sets_of_other_size(diagnosis):
        certain = certain_effects(diagnosis)
        unlike = [[name for name in one if name not in certain] for one in (names, *sets)]
        single = [name for one in names for name in rivals.get(one, []) if len(unlike[0]) == 1]
        return [join_as_one(unlike[0]), *single, *(join_as_one(one) for one in unlike[1:] if one), *whole]
    first = next((name for name in names if rivals.get(name)), None)
    if first is None:
        return [*names, *whole] if whole else names[:1]
    return [first, *rivals[first], *whole]


def join_as_one(names: Sequence[str]) -> str:
    """Return several effects as one explanation.

    Examples
    --------
    >>> join_as_one(["drag", "thermal", "slope"])
    'drag with thermal and slope'

    """
    first, *others = names
    return f"{first} with {' and '.join(others)}" if others else first


def _formula_rival(diagnosis: Mapping[str, Any]) -> list[str]:
    """The best formula in words, if effects are named and these runs cannot exclude it."""
    rival = (diagnosis.get("unexplained") or {}).get("rival")
    return [rival] if rival and diagnosis["verdict"] == "ambiguous" else []


def describe_alternatives(diagnosis: Mapping[str, Any]) -> list[str]:
    """Describe the sets of effects that differ from several named ones in more than one effect and explain as much.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis.

    Returns
    -------
    list of str
        One sentence for every set, without a full stop.

    Examples
    --------
    >>> sets = [{"effects": ["drag", "slope", "texture"], "delta_bic": 2.0}]
    >>> describe_alternatives({"missing": ["texture", "spring", "drift"], "alternatives": sets})
    ['drag and slope together explain as much as spring and drift']

    """
    named = diagnosis["missing"]
    out = []
    for one in diagnosis.get("alternatives") or []:
        instead = [name for name in one["effects"] if name not in named]
        replaced = [name for name in named if name not in one["effects"]]
        if instead and replaced and max(len(instead), len(replaced)) > 1:
            verb = "together explain" if len(instead) > 1 else "alone explains"
            out.append(f"{' and '.join(instead)} {verb} as much as {' and '.join(replaced)}")
    return out


def force_without_effect(diagnosis: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the force that no effect explains, or that formulas may explain as well as the effects; else None.

    Examples
    --------
    >>> unlikely = {"words": "a formula explains as much", "rival": None, "decisive": False}
    >>> force_without_effect({"verdict": "missing", "unexplained": unlikely}) is None
    True

    """
    left = diagnosis.get("unexplained")
    # a diagnosis that was stored before "rival" existed has "words" where a formula explains as much
    return left if left and (left.get("rival", "words" in left) or diagnosis["verdict"] == "unexplained") else None


def describe_open_question(diagnosis: Mapping[str, Any]) -> str:
    """Describe the first question that the runs cannot answer, and what would answer it.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis. Its `undetermined` lists `what`, `why` and `settled_by`.

    """
    gaps = diagnosis.get("undetermined") or NOT_SAID
    first, more = gaps[0], len(gaps) - 1
    others = f" (and {more} more)" if more else ""
    advice = f"; to settle it: {first['settled_by']}" if first["settled_by"] else ""
    return f"{first['what']}: {first['why']}{others}{advice}"


def formula_evidence(formula: Mapping[str, Any]) -> str:
    """Return the share of the misfit that a formula explains, and the evidence for it."""
    return f"{100 * formula['share']:.1f} % of the misfit, delta BIC {format_change(formula['delta_bic'])}"


def describe_formula(formula: Mapping[str, Any]) -> list[str]:
    """Describe how certain the form of a formula is: its probability, and the formulas that predict the same data.

    Parameters
    ----------
    formula : mapping
        An entry of `formulas` of the JSON of a diagnosis.

    Returns
    -------
    list of str
        Phrases; none for a diagnosis that was stored before probabilities were computed.

    Examples
    --------
    >>> describe_formula({"formula": "2 N exp(-x/3 m)", "probability": 0.873, "equivalents": []})
    ['probability of this form 87 %']

    """
    probability = formula.get("probability")
    said = [] if probability is None else [f"probability of this form {format_share(max(probability, 1e-9))}"]
    equal = formula.get("equivalents") or []
    if not equal:
        return said
    more = f" or {len(equal) - MAX_EQUIVALENTS_NAMED} others" if len(equal) > MAX_EQUIVALENTS_NAMED else ""
    return [*said, f"these runs cannot distinguish it from {', '.join(equal[:MAX_EQUIVALENTS_NAMED])}{more}"]


def describe_unnamed(unexplained: Mapping[str, Any]) -> str:
    """Describe the probability that none of the formulas listed has the right form; "" if it is not known."""
    probability = unexplained.get("probability_none")
    said = "Probability that none of these forms is right"
    return "" if probability is None else f"{said}: {format_share(max(probability, 1e-9))}."


def describe_unexplained(unexplained: Mapping[str, Any]) -> str:
    """Describe the force that no effect explains: a formula for it, or the axis over which it repeats best."""
    axis = AXES[unexplained["axis"]].name
    return unexplained.get("words") or f"a force that no effect of the library explains repeats best with {axis}"


class NextExperiment(NamedTuple):
    """One experiment that a diagnosis proposes.

    Attributes
    ----------
    what : str
        What to do and why, in one sentence.
    separates : str
        The effects that it distinguishes, in words; "" where no run can distinguish them.
    expected : str
        Expected delta BIC, with its 95 % interval if that is known.
    cost : str
        Its cost, if costs are known.

    """

    what: str
    separates: str
    expected: str
    cost: str

    @property
    def words(self) -> str:
        """Which effects it distinguishes, and how well."""
        cost = f"; cost {self.cost}" if self.cost else ""
        return f"separates {self.separates}; expected delta BIC {self.expected}{cost}"


def next_experiments(diagnosis: Mapping[str, Any] | None) -> list[NextExperiment]:
    """List the experiments that a diagnosis proposes, the best first.

    Examples
    --------
    >>> step = {"what": "Film a fast run", "separates": ["drag", "drift"], "expected_delta_bic": 41.3}
    >>> next_experiments({"next_experiment": [step | {"tells": "drag and drift apart"}]})[0].words
    'separates drag and drift; expected delta BIC 41'

    """
    rows = []
    for step in (diagnosis or {}).get("next_experiment") or []:
        told = step.get("tells", ", ".join(step["separates"])).removesuffix(" apart")
        cost = "" if step.get("cost") in (None, 1.0) else format_plain(step["cost"], 3)
        rows.append(NextExperiment(step["what"], told if step["separates"] else "", expected_evidence(step), cost))
    return rows


def expected_evidence(step: Mapping[str, Any]) -> str:
    """Format the expected delta BIC of an experiment with its 95 % interval, if that is known."""
    expected = format_plain(step.get("expected_delta_bic"), 2)
    low, high = step.get("expected_interval") or (None, None)
    if low is None:
        return expected
    above = f"at least {format_plain(low, 2)}" if high is None else f"{format_plain(low, 2)} to {format_plain(high, 2)}"
    return f"{expected} (95 %: {above})"


def describe_no_run(diagnosis: Mapping[str, Any]) -> str:
    """Say why no run is named after a diagnosis.

    Examples
    --------
    >>> describe_no_run({"verdict": "missing", "missing": ["drag"]})
    'drag is missing and has no rival: add it with `frictrack add STUDY drag`'

    """
    verdict, missing = diagnosis["verdict"], diagnosis["missing"]
    if verdict == "missing" and missing:
        has = "is missing and has no rival" if len(missing) == 1 else "are missing and have no rivals"
        return f"{', '.join(missing)} {has}: add it with `frictrack add STUDY {missing[0]}`"
    if verdict == "complete":
        return "the model is complete, and one more run would show no further effect"
    return "no run that the set-up can do answers what is open; the next experiment of the diagnosis names other checks"


def describe_predictions(history: Mapping[str, Any]) -> list[str]:
    """Say what was predicted of the runs that a plan named, and what was realised.

    Parameters
    ----------
    history : mapping
        "predictions" of the JSON of `frictrack history`.

    Returns
    -------
    list of str
        One sentence for every run that was filmed.

    Examples
    --------
    >>> realised = {"true": "drag", "rival": "drift", "expected": 50.0, "delta_bic": 60.0, "factor": 1.2}
    >>> describe_predictions({"predictions": [{"filmed": "r3", "realised": realised}]})
    ['run r3 was predicted to separate drag from drift by a delta BIC of 50; it gave 60, 1.2 times as much.']

    """
    out = []
    for row in history.get("predictions") or []:
        if one := row["realised"]:
            times = "" if one["factor"] is None else f", {one['factor']:.2g} times as much"
            out.append(
                f"run {row['filmed']} was predicted to separate {one['true']} from {one['rival']} by a delta BIC of "
                f"{one['expected']:.3g}; it gave {one['delta_bic']:.3g}{times}."
            )
    return out


def describe_tests(history: Mapping[str, Any]) -> list[str]:
    """Say how probable it is that any effect named in the whole work on a study is false.

    Parameters
    ----------
    history : mapping
        "tests" and "alpha_spent" of the JSON of `frictrack history`.

    Returns
    -------
    list of str
        One sentence; empty before the first diagnosis.

    Examples
    --------
    >>> describe_tests({"tests": [{"sequence": 1}], "alpha_spent": 0.01})
    ['1 diagnosis so far: the probability that any effect named is false is at most 1 %.']

    """
    tests = history.get("tests") or []
    if not tests:
        return []
    n, sequences = len(tests), len({test["sequence"] for test in tests})
    made = f"{n} diagnos{'is' if n == 1 else 'es'} so far" + f" in {sequences} sequences of models" * (sequences > 1)
    spent = f"{100 * history['alpha_spent']:.3g} %"
    return [f"{made}: the probability that any effect named is false is at most {spent}."]


def describe_lost(lost: int, frames: int) -> str:
    """Say in how many frames of a film the target was lost.

    Examples
    --------
    >>> describe_lost(3, 150), describe_lost(0, 150)
    ('the target was lost in 3 of 150 frames', 'the target was found in all 150 frames')

    """
    found = f"was lost in {lost} of" if lost else "was found in all"
    return f"the target {found} {frames} frames"
