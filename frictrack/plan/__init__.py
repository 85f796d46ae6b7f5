"""Before any film is taken: which runs make the library tell its effects apart, at this camera's noise.

    stand = plan.usual(mass=0.35, fps=4000, pitch=5e-4)
    plan.summary(plan.choose(stand))["runs"]

Every run of a menu is simulated under the law that is assumed. Every effect of the library is put on it at a stated
size, and every other effect in its best form is fitted to what it leaves. Runs are then chosen one after the other so
that the pairs that cannot be told apart become fewest.
"""

from frictrack.plan.experiment_setup import Entry, Stand, film, menu, usual
from frictrack.plan.plan_summary import summary
from frictrack.plan.selection import PARTED, Chosen, choose
from frictrack.plan.setup_from_fit import of_fit

__all__ = ["PARTED", "Chosen", "Entry", "Stand", "choose", "film", "menu", "of_fit", "summary", "usual"]
