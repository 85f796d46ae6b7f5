"""Draw the held-out error of each model, in the order in which they were tried, over the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.number_format import describe_change, format_number
from frictrack.present.plots import style
from frictrack.present.plots.inputs import AnyModel, as_model
from frictrack.present.plots.model import noise_um
from frictrack.present.plots.style import axis_label, new_figure, plain_name, styled
from frictrack.results import ModelResults

LOG_AXIS_RATIO = 8.0  # largest over smallest error, from which the axis is logarithmic
MIN_NOISE_SHOWN = 0.02  # of the smallest error: lower noise is not drawn
MAX_CHARACTERS = 8.0  # of the names of models side by side, per inch of the panel; more models are numbered
MAX_STEPS_NAMED = 2  # effects that one model adds to the one before; of more, the whole model is named


@dataclass(frozen=True)
class HeldOutError:
    """Held-out error of one model, um or N; `tried` for an effect that the diagnosis tried but nobody added."""

    label: str
    value: float
    tried: bool = False


def errors_of_models(models: Sequence[ModelResults], unit: str) -> list[HeldOutError]:
    """Held-out errors of the models that have one, each named by what it adds to the model before."""
    key = "heldout_rms_um" if unit == "µm" else "heldout_rms_N"
    known = [m for m in models if m.summary["errors"].get(key) is not None]
    steps = zip([None, *models], models, strict=False)
    names = {model.name: _step(before, model) for before, model in steps}
    return [HeldOutError(names[m.name], float(m.summary["errors"][key])) for m in known]


def _step(previous: ModelResults | None, model: ModelResults) -> str:
    """The model, or what was added to or removed from the one before."""
    if previous is None:
        return plain_name(model.name)
    new, old = model.summary["model"], previous.summary["model"]
    gained, lost = [e for e in new if e not in old], [e for e in old if e not in new]
    steps = [*(f"+ {e}" for e in gained), *(f"without {e}" for e in lost)]
    return "\n".join(steps) if 0 < len(steps) <= MAX_STEPS_NAMED else plain_name(model.name)


@styled
def history(models: Sequence[AnyModel]) -> Figure:
    """Draw the held-out error of every model in the order in which they were fitted, and the noise.

    Parameters
    ----------
    models : sequence of ModelResults or Fit
        All models of the study.

    """
    tried = [as_model(model) for model in models]
    in_um = any(m.summary["errors"].get("heldout_rms_um") is not None for m in tried)
    unit = "µm" if in_um else "N"
    noise = noise_um(tried[-1]) if in_um else (tried[-1].diagnosis or {}).get("noise_N")
    errors = errors_of_models(tried, unit)
    figure = new_figure(3.3, _title(errors, noise, unit))
    draw_held_out(figure.subplots(), errors, noise, unit, style.PAGE_WIDTH_IN)
    return figure


def _title(errors: Sequence[HeldOutError], noise: float | None, unit: str) -> str:
    against = "" if noise is None else f", noise {format_number(noise)} {unit}"
    if not errors:
        return "No held-out error was computed"
    before, after = errors[0].value, errors[-1].value
    if len(errors) == 1:
        return f"Held-out error of {errors[0].label}: {format_number(before)} {unit}{against}"
    return f"Held-out error {describe_change(before, after, unit)}{against}"


def draw_held_out(ax: Axes, errors: Sequence[HeldOutError], noise: float | None, unit: str, width: float) -> None:
    """Draw the errors and the noise into a panel of a width in inches; models whose names have no room are numbered."""
    values = np.array([one.value for one in errors])
    longest = [max(map(len, one.label.replace(" + ", "\n+ ").split("\n"))) for one in errors]
    is_named = sum(longest) <= MAX_CHARACTERS * width
    ax.plot(range(len(values)), values, color="#777777", lw=1.4, zorder=1)
    for k, one in enumerate(errors):
        colour = style.VERMILION if k == 0 and len(errors) > 1 else style.BLUE
        ax.plot(k, one.value, "o", ms=8, mec=colour, mfc="white" if one.tried else colour, mew=1.6, zorder=2)
        if is_named or k in (0, len(errors) - 1):
            ax.annotate(format_number(one.value), (k, one.value), (0, 9), textcoords="offset points", ha="center",
                        fontweight="bold", bbox={"fc": "white", "ec": "none", "pad": 1, "alpha": 0.85})  # fmt: skip
    known = values
    if noise is not None and noise > MIN_NOISE_SHOWN * values.min(initial=np.inf):
        known = np.append(values, noise)
        ax.axhline(noise, color="black", ls=(0, (4, 2)), lw=1.2, zorder=0.5)
        ax.annotate("noise", (0, noise), (4, 3), xycoords=("axes fraction", "data"), textcoords="offset points",
                    fontsize=9)  # fmt: skip
    low, top = known.min(initial=np.inf), known.max(initial=0.0)
    if top > LOG_AXIS_RATIO * low > 0:
        style.log_axis(ax, "y")
        ax.set_ylim(0.6 * low, 2.2 * top)
    else:
        ax.set_ylim(0, 1.25 * top or 1.0)
    names = [one.label.replace(" + ", "\n+ ") + ("\n(tried)" if one.tried else "") for one in errors]
    ax.set_xticks(range(len(errors)), names if is_named else [str(k) for k in range(1, len(errors) + 1)])
    ax.set_xlabel("" if is_named else "models in the order tried")
    ax.set_xlim(-0.5, len(errors) - 0.5)
    ax.set_ylabel(axis_label("held-out error, rms", unit))
