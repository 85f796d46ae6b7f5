"""Make the gallery of effects: one page and two pictures for every effect of the library."""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from collections.abc import Collection, Iterator
from importlib import import_module
from pathlib import Path

import gallery_figures
import gallery_fit
import gallery_runs
import gallery_separation
import page_text
from gallery_figures import failure_figure, thumbnail
from gallery_fit import Failure, fit_without
from gallery_runs import EXAMPLES, Example
from gallery_separation import Separation, separating_run
from page_text import code, keep_only, plain, prose, sentence, small_png, table, write_page

from frictrack import __version__, effects
from frictrack.base.number_format import format_number
from frictrack.diagnose import MIN_CHI2_SEPARATED
from frictrack.effects import Effect, Parameter
from frictrack.effects.definition import EVERY_FORCE, NEEDS

WIDE_PAGE = "---\nhtml_theme.sidebar_secondary.remove: true\n---\n"
MAX_LOOKALIKES = 4  # effects in the table of what an effect is confused with
MIN_SHARE_SHOWN = 0.2  # of the misfit, that an effect must explain to be listed
PICTURE_DPI, THUMBNAIL_DPI = 130, 110
GROUPS = {
    "Forces that belong to friction": (
        *("coulomb", "stribeck", "viscous", "drag", "thermal", "drift", "asymmetry"),
        *("flash_weakening", "log_velocity", "power_law_viscosity", "adhesion"),
        *("load_exponent", "run_in", "heating"),
        *("presliding", "friction_lag", "lugre", "bouc_wen", "atm2:2"),
        *("elasto_plastic", "maxwell_slip", "rate_state_ageing", "rate_state_slip", "hydrodynamic_hump"),
    ),
    "Forces of the course": ("texture", "patch", "spring", "slope", "gravity", "collision", "eddy_brake"),
    "Vibrations": (
        *("vibration", "decaying_vibration", "beam_vibration", "elastic_joint"),
        *("load_modulation", "measured_load", "viscous_modulation"),
    ),
    "Errors of the measurement": (
        *("drive_error", "drive_delay", "drive_offset", "cell_lag", "cell_delay", "cell_drift"),
        *("lens", "peak_locking", "camera_shake", "dropped_frame", "timebase"),
        *("clock_rate", "target_rotation", "rolling_shutter", "out_of_plane"),
    ),
}
SCALES = {
    "load": "the normal load of the run",
    "mass": "the mass of the run",
    "drive": "the drive of the run",
    "nothing": "nothing: it is the same in runs of another load",
}


def make_gallery(folder: Path, simulated: Collection[str] | None = None) -> None:
    """Write the pages and pictures of all effects into a folder, and the cards that lead to them.

    An effect of which nothing has changed since the last build is not simulated again.

    Parameters
    ----------
    folder
        Folder of the generated files.
    simulated
        Effects to simulate where they have changed; the pages of other changed effects hold only what the definition
        says. None: all.

    """
    folder.mkdir(parents=True, exist_ok=True)
    marks_file = folder / "made.json"
    marks = json.loads(marks_file.read_text()) if marks_file.exists() else {}
    for name in all_effects():
        mark = _mark(name)
        if marks.get(name) == mark and all((folder / file).exists() for file in _files(name)):
            continue
        if name in EXAMPLES and (simulated is None or name in simulated):
            sys.stderr.write(f"gallery: {name}\n")
            _make_page(folder, name)
            marks[name] = mark
        else:
            write_page(folder / _files(name)[0], effect_page(name))
            marks.pop(name, None)
        write_page(marks_file, json.dumps(marks, indent=1))
    keep_only(folder, map(page_name, all_effects()))
    write_page(folder / "cards.txt", _cards(marks))


def all_effects() -> list[str]:
    """Return the names of all effects of the library, in the order of `frictrack effects`."""
    return [entry["name"] for entry in effects.catalogue() if entry["name"] not in effects.DECLARED]


def page_name(effect: str) -> str:
    """Return the name of an effect's page, without suffix.

    Examples
    --------
    >>> page_name("atm2:2")
    'atm2'

    """
    return effect.partition(":")[0]


def _files(name: str) -> list[str]:
    page = page_name(name)
    return [f"{page}.md", f"{page}.png", f"{page}_small.png"]


def _mark(name: str) -> str:
    """Hash of what the page of an effect is made from: version, definition of the effect and generators."""
    definition = f"frictrack.effects.{'' if ':' in name else 'library.'}{page_name(name)}"
    modules = [import_module(definition), gallery_figures, gallery_fit, gallery_runs, gallery_separation, page_text]
    sources = [__version__, *(inspect.getsource(module) for module in modules), Path(__file__).read_text()]
    return hashlib.sha256("".join(sources).encode()).hexdigest()


def _make_page(folder: Path, name: str) -> None:
    failure = fit_without(name, EXAMPLES[name])
    page, picture, small = (folder / file for file in _files(name))
    picture.write_bytes(small_png(failure_figure(failure), PICTURE_DPI))
    small.write_bytes(small_png(thumbnail(failure), THUMBNAIL_DPI))
    write_page(page, effect_page(name, failure))


def _cards(drawn: Collection[str]) -> str:
    """Return the cards of all effects by group, for the index page; `drawn` are the effects that have a picture."""
    listed = {name for names in GROUPS.values() for name in names}
    groups = GROUPS | {"Further effects": tuple(name for name in all_effects() if name not in listed)}
    return "\n".join(_group(title, names, drawn) for title, names in groups.items() if names)


def _group(title: str, names: tuple[str, ...], drawn: Collection[str]) -> str:
    cards = "\n".join(_card(name, name in drawn) for name in names)
    pages = "\n".join(f"{name} <effects/{page_name(name)}>" for name in names)
    tree = f"```{{toctree}}\n:hidden:\n:caption: {title}\n\n{pages}\n```\n"
    return f"## {title}\n\n::::{{grid}} 1 2 3 3\n:gutter: 3\n\n{cards}\n::::\n\n{tree}"


def _card(name: str, drawn: bool) -> str:
    page, effect = page_name(name), effects.get(name)
    picture = f":img-bottom: effects/{page}_small.png\n:img-alt: What a fit leaves where {name} acts\n" if drawn else ""
    return (
        f":::{{grid-item-card}} {name}\n:link: effects/{page}\n:link-type: doc\n{picture}\n"
        f"{plain(sentence(effect.looks_like))}\n:::\n"
    )


def effect_page(name: str, failure: Failure | None = None) -> str:
    """Return the page of one effect as Markdown.

    Parameters
    ----------
    name
        Name of the effect.
    failure
        A fit without the effect to runs that have it; without it the page holds only what the definition says.

    """
    effect = effects.get(name)
    parts = [
        WIDE_PAGE,
        f"# {name}\n\n{plain(effect.what)}\n",
        f"```text\n{'F' if effect.acts_on == 'force' else 'y'} += {effect.equation.removeprefix('y: ')}\n```\n",
        "## What a fit without it leaves\n",
        f"{plain(sentence(effect.looks_like))}\n",
        _figure(failure) if failure else "",
        "## What it is confused with\n",
        f"{plain(sentence(effect.mistaken_for))}\n",
        _lookalikes(failure) if failure else "",
        "## The run that separates them\n",
        *_separation(effect, failure),
        "## Parameters\n",
        _parameters(effect),
        _facts(effect),
        "## Use it\n",
        f"```sh\nfrictrack add study.toml {name}\n```\n",
        f'```python\nfit = ft.fit([*fit.model.names, "{name}"], runs)\n```\n',
    ]
    return "\n".join(parts)


def _facts(effect: Effect) -> str:
    """Return a table: what the effect acts on, what it scales with, what it needs, where it is from."""
    rows = [
        ["acts on", _acts_on(effect)],
        ["its size follows", SCALES[effect.scales_with]],
        ["changes", ", ".join(n if effect.modifies == EVERY_FORCE else _link(n) for n in sorted(effect.modifies))],
        ["stands in place of", ", ".join(_link(name) for name in sorted(effect.replaces))],
        ["tried by a diagnosis", _when_tried(effect)],
        ["needs", plain(" and ".join(NEEDS[need][0] for need in effect.needs))],
        ["remembers", "the motion so far" if effect.memory else ""],
        ["source", plain(effect.source)],
    ]
    symbols = "The equation uses the [symbols](../index.md#symbols) of all effects.\n\n"
    return symbols + table(["property", "value"], [row for row in rows if row[1]])


def _when_tried(effect: Effect) -> str:
    """When a diagnosis tries an effect that stands in place of others."""
    if not effect.replaces:
        return ""
    tried = any(effect in effects.laws_in_place_of(effects.get(name)) for name in effect.replaces)
    return "where that one explains most" if tried else "no: add it, and compare the two fits"


def _parameters(effect: Effect) -> str:
    """Return the table of parameters with their units, and with bounds where one has any."""
    names = ["parameter", "unit", "lowest", "highest", "fitted"]
    rows = [[code(p.name), plain(p.unit if p.unit != "1" else "–"), *_bounds(p), _kind(p)] for p in effect.parameters]
    if all(low == high == "–" for _, _, low, high, _ in rows):
        return table(names[:2] + names[4:], [row[:2] + row[4:] for row in rows])
    found = table(names, rows)
    if not any(p.name in effect.quoted and row[2] != "–" for p, row in zip(effect.parameters, rows, strict=True)):
        return found
    forms = ", ".join(code(p.name) for p in effect.parameters if p.name in effect.quoted)
    return f"{found}\nThe bounds of {forms} belong to the form in which it is fitted.\n"


def _bounds(p: Parameter) -> list[str]:
    """Return both bounds as text."""
    return [f"{bound:g}" if abs(bound) < float("inf") else "–" for bound in p.bounds]


def _kind(p: Parameter) -> str:
    if p.fixed is not None:
        return f"no: {format_number(p.fixed)}, unless it is freed"
    return "one value per run" if p.per_run else "one value for all runs"


def _figure(failure: Failure) -> str:
    page = page_name(failure.effect)
    text = (
        f"{_size_of(failure.example, failure.effect)}. The runs were fitted with {' + '.join(failure.example.law)}: "
        f"reduced chi-squared {format_number(failure.fit.reduced_chi2)}. Above, measured less modelled displacement; "
        "below, measured less modelled friction force."
    )
    alt = "Residual and missing force over time, position and velocity"
    return f"```{{figure}} {page}.png\n:alt: {alt}\n\n{plain(text)}\n```\n"


def _size_of(example: Example, effect: str) -> str:
    """Describe the simulated effect in one sentence, without its full stop."""
    varied = {name for own in example.per_run.values() for name in own}
    values = {name: value for name, value in example.truth[effect].items() if name not in varied}
    units = {p.name: p.unit for p in effects.get(effect).parameters}
    known = effects.get(effect).quote
    if known is not None:
        everything = {f"{e}.{p}": v for e, own in example.truth.items() for p, v in own.items()}
        values |= {k: v for k, v in known(dict(example.truth[effect]), everything).items() if k in values}
    said = [f"{name} = {value:.4g} {units[name]}".removesuffix(" 1") for name, value in values.items()]
    count = {2: "Two", 3: "Three", 4: "Four"}[len(example.design or gallery_runs.SLIDES)]
    noise = f"{1e6 * gallery_runs.NOISE_M:g}"
    return (
        f"{count} simulated runs, noise {noise} µm per frame, with " + ", ".join(said)
        if said
        else (f"{count} simulated runs, noise {noise} µm per frame")
    )


def _lookalikes(failure: Failure) -> str:
    """Return the table of effects that would explain the most of the misfit of these runs."""
    if not failure.explained:
        levels = ", ".join(f"{level:.2f} ({run})" for run, level in failure.levels.items())
        return f"In the runs above, it leaves no misfit: the friction levels of the runs take it up, {levels}.\n"
    shown = [item for item in failure.lookalikes[:MAX_LOOKALIKES] if item[1] >= MIN_SHARE_SHOWN]
    if not shown:
        return "In the runs above, no other effect of the library explains a fifth of the misfit.\n"
    rows = [[_link(name), f"{100 * share:.0f} %"] for name, share in shown]
    return (
        "In the runs above, another effect in its place explains [this share](../index.md) of the misfit:\n\n"
        + table(["effect", "share of the misfit"], rows)
    )


def _separation(effect: Effect, failure: Failure | None) -> Iterator[str]:
    """Yield what to do: the effect's own test, the planned run for the pair, and a direct measurement."""
    yield f"{prose(sentence(effect.confirm))}\n"
    if failure and failure.lookalikes:
        yield from _planned_run(failure.effect, failure.lookalikes[0][0])
    if effect.invariant:
        yield f"What stays the same when a run is made differently: {plain(effect.invariant)}.\n"
    if effect.direct_check is not None:
        yield f"Without a run: {prose(sentence(effect.direct_check.instruction))}\n"


def _planned_run(effect: str, rival: str) -> Iterator[str]:
    found = separating_run(effect, rival)
    if found is not None and found.is_separated:
        yield _calculation(f"{_link(effect)} and {_link(rival)}", found)


def _calculation(pair: str, found: Separation) -> str:
    """Describe the planned run for a pair."""
    sizes = f"By calculation, for {pair} of the sizes that `frictrack plan` assumes"
    needed = (
        f"(expected chi-squared {{}}; {MIN_CHI2_SEPARATED:g} is enough). `frictrack plan` plans for your own setup.\n"
    )
    if found.before >= MIN_CHI2_SEPARATED:
        return f"{sizes}: {plain(found.first)} distinguishes the two {needed.format(_rounded(found.before))}"
    film = f"after {plain(found.first)}, which does not distinguish the two, film **{prose(found.best)}**"
    return f"{sizes}: {film} {needed.format(_rounded(found.after))}"


def _rounded(chi2: float) -> str:
    return f"{chi2:,.0f}" if chi2 < 1e5 else "more than 100,000"


def _acts_on(effect: Effect) -> str:
    if "friction" in effect.needs:
        return "the force that a load cell shows"
    return "the force on the mass" if effect.acts_on == "force" else "the measured position"


def _link(name: str) -> str:
    return f"[{name}]({page_name(name)}.md)"
