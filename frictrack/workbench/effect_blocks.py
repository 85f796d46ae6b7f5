"""Show each effect of the model as a block: its equation, its fitted parameters and their settings.

Settings are written to the effect's ``[[effect]]`` table of the study file; the next fit uses them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any

import panel as pn

from frictrack.errors import FrictrackError
from frictrack.number_format import format_quantity
from frictrack.report import mark_equation
from frictrack.units import parse_quantity
from frictrack.workbench.page_state import PageState
from frictrack.workbench.widgets import button, html

FREE = "free"  # typed in `fixed at`: fit a parameter that the library fixes
LIBRARY_DEFAULT = "default"
PER_RUN_CHOICES = {LIBRARY_DEFAULT: None, "own value in every run": True, "one value for all runs": False}
BLOCK_STYLE = {"border": "1px solid #c8c8c8", "border-top": "5px solid #0072b2", "padding": "8px"}


class EffectBlocks:
    """The blocks of the current model. They are rebuilt only for another model, so that typing is not interrupted."""

    def __init__(self, state: PageState) -> None:
        self.state = state
        self.view = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
        self._open: set[str] = set()
        self._boxes: list[_ParameterBoxes] = []
        self._shown: object = None

    def show(self, library: dict[str, dict[str, Any]]) -> None:
        """Show the current model.

        Parameters
        ----------
        library : dict
            Entry of the catalogue by the name of the effect: equation, parameters with units and bounds.

        """
        model = self.state.model
        summary = model.summary if model else {"model": [], "parameters": {}}
        made = (model.name if model else "", summary["model"], summary["parameters"])
        if made != self._shown:
            self._boxes, self._shown = [], made
            names = ((name, library.get(name) or library.get(name.split(":")[0], {})) for name in summary["model"])
            self.view.objects = [self._block(name, entry) for name, entry in names]
        for box in self._boxes:
            box.fill()

    def _block(self, name: str, entry: dict[str, Any]) -> pn.Column:
        given = {p["name"]: p for p in entry.get("parameters", [])}
        values = _values(self.state, name)
        rows: list[Any] = []
        more: list[Any] = []
        for parameter in dict.fromkeys((*values, *given)):
            about = given.get(parameter, {"unit": next(iter(values[parameter].values()))["unit"], "bounds": None})
            box = _ParameterBoxes(self.state, name, parameter, about)
            self._boxes.append(box)
            rows += [html(_parameter_line(parameter, values.get(parameter, {}))), pn.Row(box.fix, box.low, box.high)]
            more.append(pn.FlexBox(box.prior, box.tie, box.per_run, gap="4px"))
        settings = pn.Card(
            *more,
            title="Priors, ties, values per run",
            collapsed=name not in self._open and not any(_settings_of(self.state, name, k) for k in ADVANCED_KEYS),
            sizing_mode="stretch_width",
            header_background="#f3f3f3",
        )
        settings.param.watch(lambda e: (self._open.discard if e.new else self._open.add)(name), "collapsed")
        return pn.Column(
            html(f"<h3 class=ft-h>{escape(name)}</h3><p class=ft-note>{mark_equation(entry.get('equation', ''))}</p>"),
            *rows,
            settings,
            button(f"Remove {name}", lambda: self.state.start_job("remove", effect=name)),
            width=400,
            styles=BLOCK_STYLE,
        )


ADVANCED_KEYS = ("prior", "tie", "per_run")


class _ParameterBoxes:
    """The input boxes of one parameter: they show the settings in the study file and write what is typed."""

    def __init__(self, state: PageState, effect: str, name: str, about: dict[str, Any]) -> None:
        self.state, self.effect, self.name = state, effect, name
        self.unit, self.bounds = about["unit"], about["bounds"]

        self.fix, self.low, self.high = (
            pn.widgets.TextInput(label=label, width=90) for label in ("fixed at", "at least", "at most")
        )
        self.prior = pn.widgets.TextInput(label=f"{name}: prior", placeholder="mean ± std", width=112, margin=4)
        self.tie = pn.widgets.TextInput(label=f"{name}: tied to", placeholder="2*effect.name", width=130, margin=4)
        self.per_run = pn.widgets.Select(label=f"{name}: per run", options=list(PER_RUN_CHOICES), width=102, margin=4)
        self._filled: dict[Any, str] = {}
        self._filling = False
        self.fill()
        for box, key, read in (
            (self.fix, "fix", self._fixed),
            (self.low, "bounds", self._bound),
            (self.high, "bounds", self._bound),
            (self.prior, "prior", self._prior),
            (self.tie, "tie", lambda text: text or None),
            (self.per_run, "per_run", PER_RUN_CHOICES.__getitem__),
        ):
            box.param.watch(partial(self._on_typed, key, read), "value")

    def fill(self) -> None:
        """Show the settings in the study file. A rejected text stays in its box until the setting changes."""
        fixed, bounds, prior, tie, own = (self._own_setting(key) for key in ("fix", "bounds", *ADVANCED_KEYS))
        low, high = ("", "") if bounds is None else (f"{side:g}" for side in bounds)
        texts = {
            self.fix: "" if fixed is None else FREE if fixed is False else f"{fixed:g}",
            self.low: low,
            self.high: high,
            self.prior: "" if prior is None else f"{prior[0]:g} ± {prior[1]:g}",
            self.tie: tie or "",
            self.per_run: next(words for words, value in PER_RUN_CHOICES.items() if value is own),
        }
        self._filling = True
        for box, text in texts.items():
            if self._filled.get(box) != text:
                self._filled[box] = box.value = text
        self._filling = False

    def _own_setting(self, key: str) -> Any:
        return _settings_of(self.state, self.effect, key).get(self.name)

    def _on_typed(self, key: str, read: Callable[[Any], Any], event: Any) -> None:
        """Write a typed setting to the study file, or report why it cannot be read."""
        if self._filling:
            return None
        try:
            value = read(event.new.strip() if isinstance(event.new, str) else event.new)
        except FrictrackError as e:
            return self.state.notify(f"{self.effect}: {e}", is_error=True)
        old = _settings_of(self.state, self.effect, key)
        new = {**old, self.name: value} if value is not None else {k: v for k, v in old.items() if k != self.name}
        if new != old:
            plain = {k: list(v) if isinstance(v, tuple) else v for k, v in new.items()}
            self.state.apply_change("edit", table="effect", which=self.effect, key=key, value=plain or None)
        return None

    # --- texts -> values; each raises FrictrackError for a text that it cannot read

    def _fixed(self, text: str) -> float | bool | None:
        if text == FREE:
            return False
        return parse_quantity(text, self.unit, f"{self.name} fixed")[0] if text else None

    def _bound(self, typed: str) -> tuple[float, float] | None:
        """Read both bounds; an empty one is taken from the library."""
        texts = [(box.value or "").strip() for box in (self.low, self.high)]
        if not any(texts):
            return None
        wide = self.bounds or [None, None]
        low, high = (
            parse_quantity(text, self.unit, f"a bound of {self.name}")[0] if text else wide[i]
            for i, text in enumerate(texts)
        )
        if low is None or high is None:
            raise FrictrackError(
                f"expected both bounds of {self.name} but got one; the library has no bound on the other side"
            )
        return low, high

    def _prior(self, text: str) -> tuple[float, float] | None:
        if not text:
            return None
        mean, std = parse_quantity(text, self.unit, f"a prior of {self.name}")
        if std == 0.0:
            raise FrictrackError(
                f'expected a prior of {self.name} as mean ± standard deviation, like "60 ± 2", but got "{text}"'
            )
        return tuple(float(f"{q:.12g}") for q in (mean, std))  # type: ignore[return-value]


def _settings_of(state: PageState, effect: str, key: str) -> dict[str, Any]:
    """Settings of one kind of an effect's parameters in the study file."""
    tables = state.study.effects if state.study else ()
    return next((dict(getattr(t, key)) for t in tables if t.effect == effect), {})


def _values(state: PageState, name: str) -> dict[str, dict[str, Any]]:
    """Fitted values of an effect: parameter -> run (or "" for all runs) -> value."""
    assert state.model is not None
    out: dict[str, dict[str, Any]] = {}
    for full, value in state.model.summary["parameters"].items():
        address, _, run = full.partition("[")
        effect, _, parameter = address.rpartition(".")
        if effect == name:
            out.setdefault(parameter, {})[run.rstrip("]")] = value
    return out


def _parameter_line(parameter: str, values: dict[str, Any]) -> str:
    """A parameter with its value and standard deviation, or its values in each run, as HTML."""
    entry = "; ".join(f"{escape(run)} {_value(value)}" if run else _value(value) for run, value in values.items())
    return f"<b>{mark_equation(parameter)}</b> = {entry or 'no value yet: fit again'}"


def _value(value: dict[str, Any]) -> str:
    reason = f" ({value['reason']})" if value.get("reason") else ""
    if value["value"] is None:
        return escape(f"not determined{reason}")
    std, mark = value.get("std_misfit"), " (†: ± with the misfit)"
    std, mark = (value.get("std"), "") if std is None else (std, mark)
    return escape(f"{format_quantity(value['value'], std, value['unit'])}{mark}{reason}")
