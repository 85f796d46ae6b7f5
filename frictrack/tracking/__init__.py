"""Track a target through a film: its position in pixels, with a standard deviation and a score per frame.

The method is image correlation with a learnt template: zero-normalised cross-correlation finds the target, and
Gauss-Newton refines its position and small rotation by weighted least squares on the grey values.

driver              the sequence of steps: `track`, `learn_target`, and targets that several films of a study show
detection           what to track: moving bodies, clicks, rectangles, a fixed reference
batch_tracker       predict, read and refine batches of frames; search where that fails
template_learning   the template and the noise of its pixels; learning_rounds repeats it with measurement
measure             positions in every frame, without pixels that do not fit; followed_target does it for all frames
pose_tracker        targets that rotate by any angle
checks              self-checks of a track
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.base import lazy_names

if TYPE_CHECKING:
    from frictrack.tracking import checks, detection
    from frictrack.tracking.areas import Areas, is_polygon
    from frictrack.tracking.batch_tracker import Work
    from frictrack.tracking.detection import find_reference, find_target
    from frictrack.tracking.driver import (
        align_track,
        learn_target,
        relearn_target,
        track,
        track_and_learn,
        track_frames,
        track_same_target,
    )
    from frictrack.tracking.show import contact_sheet, overlay_video, target_line
    from frictrack.tracking.template import TargetModel

__getattr__, __all__ = lazy_names(__name__)
