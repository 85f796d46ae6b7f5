"""Plan runs before filming: choose those that distinguish the effects of the library at the noise of this camera.

    setup = plan.default_setup(mass=0.35, fps=4000, pitch=5e-4)
    plan.summarise_plan(plan.choose_runs(setup))["runs"]

Every candidate run is simulated with the assumed friction law. Each effect of the library is added at a planned size,
and every other effect is fitted to it over its whole scan (linearised). The expected chi-squared that the best fit
leaves is the criterion of T-optimal designs. Runs are chosen greedily so that the fewest pairs stay inseparable.

References
----------
Hunter & Reiner (1965), Technometrics 7, 307-323.
Atkinson & Fedorov (1975), Biometrika 62, 57-70.

"""

from frictrack.diagnose.experiments import (
    ExperimentSetup,
    RunPlan,
    candidate_runs,
    choose_runs,
    default_setup,
    fitted_setup,
    next_run,
    summarise_plan,
)

__all__ = [
    "ExperimentSetup",
    "RunPlan",
    "candidate_runs",
    "choose_runs",
    "default_setup",
    "fitted_setup",
    "next_run",
    "summarise_plan",
]
