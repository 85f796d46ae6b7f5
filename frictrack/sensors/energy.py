"""Compare the kinetic energy at release with that of the impact: a check of scale, frame rate and mass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

IMPOSSIBLE_SIGMAS = 3.0  # standard deviations above the stated energy that cannot be chance
SUSPICIOUS_SHARE = 0.1  # of the stated energy; less suggests a wrong scale, frame rate or mass


@dataclass(frozen=True)
class ReleaseEnergy:
    """Kinetic energy at release.

    Attributes
    ----------
    kinetic, sigma : float
        Energy and its standard deviation, J.
    share : float
        Over the stated energy.
    verdict : str
        "plausible", "impossible" or "suspicious".
    says : str
        One sentence for the user.

    """

    kinetic: float
    sigma: float
    share: float
    verdict: str  # "plausible", "impossible", "suspicious"
    says: str


def release_energy(
    mass: tuple[float, float], speed: tuple[float, float], stated: float, scale_error: float = 0.0
) -> ReleaseEnergy:
    """Compare the kinetic energy m v^2 / 2 at release with the stated energy of the impact.

    Parameters
    ----------
    mass, speed : tuple of float
        Value and standard deviation, kg and m/s.
    stated : float
        Energy of the impact, J.
    scale_error : float
        Relative standard deviation of the scale; the energy is proportional to its square.

    Returns
    -------
    ReleaseEnergy
        Energy and verdict.

    Examples
    --------
    >>> release_energy((0.5, 0.0), (2.0, 0.0), stated=2.0).verdict
    'plausible'

    """
    (m, sigma_m), (v, sigma_v) = mass, speed
    kinetic = 0.5 * m * v**2
    relative = np.sqrt((sigma_m / m) ** 2 + (2.0 * sigma_v / v) ** 2 + (2.0 * scale_error) ** 2) if v else 0.0
    sigma, share = float(kinetic * relative), float(kinetic / stated)
    if kinetic - IMPOSSIBLE_SIGMAS * sigma > stated:
        return ReleaseEnergy(kinetic, sigma, share, "impossible", _impossible(kinetic, sigma, stated))
    if share < SUSPICIOUS_SHARE:
        return ReleaseEnergy(kinetic, sigma, share, "suspicious", _suspicious(kinetic, sigma, stated))
    return ReleaseEnergy(kinetic, sigma, share, "plausible", f"E_kin / E_impact = {share:.2g}")


def _impossible(kinetic: float, sigma: float, stated: float) -> str:
    factor = kinetic / stated
    return (
        f"the kinetic energy at release, {kinetic:.3g} +/- {sigma:.2g} J, is more than the {stated:g} J of the blow: "
        f"scale or frame rate is too large by a factor of {np.sqrt(factor):.3g} or more, or the mass by {factor:.3g}; "
        "check these, or impact_energy"
    )


def _suspicious(kinetic: float, sigma: float, stated: float) -> str:
    factor = stated / max(kinetic, 1e-300)
    return (
        f"the kinetic energy at release, {kinetic:.3g} +/- {sigma:.2g} J, is less than a tenth of the {stated:g} J "
        f"of the blow: scale or frame rate too small by a factor of up to {np.sqrt(factor):.3g}, or the mass by "
        f"{factor:.3g}, would explain it, as would a glancing blow; check these, or impact_energy"
    )
