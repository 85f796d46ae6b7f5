"""Peak locking: the tracker pulls positions toward whole pixels."""

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import MAX_LOCKING_PX, Span, wave


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Pitch sin(2 pi x/pitch + phase), shape (n, 1): m per px of amplitude."""
    pitch = path.pixel_pitch
    assert pitch is not None
    return pitch * wave(path.x / pitch, nonlinear["phase"])


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to an amplitude beyond what interpolation does."""
    size = abs(values["amplitude"])
    objection = f"{size:.2g} px is more than interpolation does (at most {MAX_LOCKING_PX:g} px)"
    return "" if size <= MAX_LOCKING_PX else objection


acts_on = "measurement"
equation = "y: amplitude pitch sin(2 pi x/pitch + phase)"
parameters = (
    Parameter("amplitude", "px", linear=True, role="amplitude"),
    Parameter("phase", "rad", role="phase"),
)
what = "Sub-pixel interpolation favours some positions between pixels."
looks_like = "ripples of one pixel period; a slow false force where the mass moves a whole number of px per frame"
mistaken_for = "texture with a very short period"
confirm = "Change the zoom: the period follows the pixel, not the course."
describe = Phrase("± {abs(amplitude):2} px, once in every pixel")
invariant = "peak locking follows the pixel, not the course"
noted_as = ("peak locking",)
source = "Raffel et al., Particle Image Velocimetry; anchors: Sensors 20:6596"
needs = ("pixel_pitch",)
