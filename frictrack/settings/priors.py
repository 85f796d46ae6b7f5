"""Read and write prior files: a friction law that was identified on one set-up, as a prior for another.

A prior file is TOML: one ``[[parameter]]`` per parameter with value, standard deviation and correlations with the
parameters before it. It is checked when it is read. Values that scale with the normal load belong to the load that the
file states; `Prior.at_load` converts them.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from frictrack.base.arguments import checked
from frictrack.base.errors import FrictrackError, UsageError, describe_invalid
from frictrack.base.files import read_small_text, replace_text
from frictrack.records import Array

FORMAT = 1  # version of the file format
MAX_PRIOR_BYTES = 1 << 18  # a file of 30 parameters has 10 kB
MAX_PARAMETERS = 60
MIN_EIGENVALUE = 1e-12  # of a correlation matrix; smaller ones are not positive definite
SCALES = ("nothing", "load")
COMMENT = """A friction law as a prior for another set-up; written by `frictrack export STUDY --to prior`.
Use it there with prior = "this file" in [study]. Values that scale with the load belong to the load below."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class _Head(_Table):
    """The table ``[prior]``."""

    format: Literal[1]
    study: str = ""
    model: list[str] = []
    load: float | None = None


class _Parameter(_Table):
    """A table ``[[parameter]]``; it has its correlations with the parameters above it."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*(:[0-9]+)?\.[A-Za-z][A-Za-z0-9_]*$")]
    value: float
    std: Annotated[float, Field(gt=0)]
    unit: str
    scales_with: Literal["nothing", "load"]
    correlation: dict[str, Annotated[float, Field(ge=-1, le=1)]] = {}


class _File(_Table):
    """A prior file."""

    prior: _Head
    parameter: Annotated[list[_Parameter], Field(min_length=1, max_length=MAX_PARAMETERS)]


@dataclass(frozen=True)
class Prior:
    """What is known of parameters before a fit: a multivariate normal distribution.

    Attributes
    ----------
    names : tuple of str
        Addresses of the K parameters, such as "coulomb.F_c".
    values : tuple of float
        Means, in SI units.
    covariance : tuple of tuple of float
        Covariance (K, K).
    units : tuple of str
        SI units.
    loaded : tuple of bool
        Whether a value is proportional to the normal load.
    load : float or None
        Normal load to which these values belong, N; None if it is not known.
    study : str
        Name of the study on which the law was identified.
    model : tuple of str
        Effects of that law.
    left_out : tuple of (str, str)
        Parameters of the law that are not in the prior, each with the reason.

    Examples
    --------
    >>> prior = Prior(("coulomb.F_c",), (0.9,), ((0.0025,),), ("N",), (True,), load=3.0)
    >>> print(prior)
    coulomb.F_c = 0.9 +/- 0.05 N at a load of 3 N
    >>> round(prior.at_load(6.0).values[0], 3), round(prior.inflated(scale=2.0).std[0], 3)
    (1.8, 0.1)

    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    units: tuple[str, ...]
    loaded: tuple[bool, ...]
    load: float | None = None
    study: str = ""
    model: tuple[str, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        k, matrix = len(self.names), np.array(self.covariance, dtype=np.float64)
        others = (self.values, self.units, self.loaded)
        if k == 0 or any(len(one) != k for one in others) or matrix.shape != (k, k):
            raise UsageError("expected one value, unit and row of the covariance for every parameter")
        std = np.sqrt(np.diag(matrix))
        if not (np.all(np.isfinite(self.values)) and np.all(np.isfinite(matrix)) and np.all(std > 0)):
            raise UsageError("expected finite values and standard deviations above 0")
        if np.min(np.linalg.eigvalsh(matrix / std / std[:, None])) < MIN_EIGENVALUE:
            raise UsageError(
                "expected correlations that can hold together (a positive definite matrix); export the law again"
            )
        if any(self.loaded) and self.load is not None and not 0 < self.load < math.inf:
            raise UsageError(f"expected a load above 0 N but got {self.load:g}")

    def __str__(self) -> str:
        rows = zip(self.names, self.values, self.std, self.units, strict=True)
        text = ", ".join(f"{name} = {value:.4g} +/- {std:.2g} {unit}".strip() for name, value, std, unit in rows)
        return text if self.load is None or not any(self.loaded) else f"{text} at a load of {self.load:.4g} N"

    @property
    def std(self) -> tuple[float, ...]:
        """Standard deviations."""
        return tuple(map(float, np.sqrt(np.diag(np.array(self.covariance)))))

    @property
    def correlation(self) -> Array:
        """Correlation matrix (K, K)."""
        std = np.array(self.std)
        return np.asarray(np.array(self.covariance) / std / std[:, None], dtype=np.float64)

    def inflated(self, scale: float = 1.0, scatter: float = 0.0) -> Prior:
        """Return the same means with larger standard deviations.

        Parameters
        ----------
        scale
            Factor on all standard deviations.
        scatter
            Relative standard deviation by which parameters differ between set-ups, independently of each other.

        Raises
        ------
        FrictrackError
            (usage) If the factor is not positive or the scatter is negative.

        """
        if not (0 < scale < math.inf and 0 <= scatter < math.inf):
            raise UsageError(
                f"expected prior_scale above 0 and prior_scatter of at least 0 but got {scale:g} and {scatter:g}"
            )
        own = np.diag((scatter * np.array(self.values)) ** 2)
        return replace(self, covariance=_rows(scale**2 * np.array(self.covariance) + own))

    def at_load(self, load: float | None) -> Prior:
        """Return the same law at another normal load.

        Parameters
        ----------
        load
            Normal load, N; None if it is not known.

        Raises
        ------
        FrictrackError
            (usage) If values scale with the load and one of the loads is not known.

        """
        if not any(self.loaded) or load == self.load:
            return replace(self, load=load)
        if load is None or self.load is None or not math.isfinite(load):
            which = "this study" if self.load is not None else f'the study of the prior ("{self.study}")'
            raise UsageError(
                f"expected a known normal load, with which {self.names[self.loaded.index(True)]} of the prior scales, "
                f"but {which} has none; give mass or normal_load there"
            )
        factor = np.where(self.loaded, load / self.load, 1.0)
        values = tuple(map(float, factor * np.array(self.values)))
        covariance = _rows(factor[:, None] * np.array(self.covariance) * factor)
        return replace(self, values=values, covariance=covariance, load=load)

    def summary(self) -> dict[str, Any]:
        """Return the JSON of a prior."""
        rows = zip(self.names, self.values, self.std, self.units, self.loaded, strict=True)
        parameters = {
            name: {"value": value, "std": std, "unit": unit, "scales_with": SCALES[loaded]}
            for name, value, std, unit, loaded in rows
        }
        r = self.correlation
        pairs = [[a, b, float(r[i, j])] for i, a in enumerate(self.names) for j, b in enumerate(self.names) if i < j]
        head = {"study": self.study, "model": list(self.model), "load": self.load}
        return head | {"parameters": parameters, "correlations": pairs, "left_out": dict(self.left_out)}

    def to_toml(self) -> str:
        """Return the text of a prior file, which `from_toml` reads."""
        import tomlkit  # noqa: PLC0415 - only to write

        head: dict[str, Any] = {"format": FORMAT, "study": self.study, "model": list(self.model)}
        head |= {} if self.load is None else {"load": self.load}
        tables: list[dict[str, Any]] = []
        for i, row in enumerate(zip(self.names, self.values, self.std, self.units, self.loaded, strict=True)):
            name, value, std, unit, loaded = row
            tables.append({"name": name, "value": value, "std": std, "unit": unit, "scales_with": SCALES[loaded]})
            pairs = zip(self.names[:i], self.correlation[i, :i], strict=True)
            if others := {other: float(r) for other, r in pairs if r != 0.0}:
                tables[-1]["correlation"] = tomlkit.inline_table()
                tables[-1]["correlation"].update(others)
        text = tomlkit.dumps({"prior": head, "parameter": tables})
        left_out = [f"left out: {name}, {reason}".replace("\n", " ") for name, reason in self.left_out]
        first, last = ("".join(f"# {line}\n" for line in lines) for lines in (COMMENT.splitlines(), left_out))
        return f"{first}\n{text}{last}"

    @checked
    def save(self, path: str | Path) -> Path:
        """Write the prior file and return its path."""
        replace_text(Path(path), self.to_toml())
        return Path(path)

    @classmethod
    @checked
    def read(cls, path: str | Path) -> Prior:
        """Read a prior file.

        Parameters
        ----------
        path
            The file.

        Raises
        ------
        FrictrackError
            (usage) If the file cannot be read or is damaged.

        """
        return cls.from_toml(read_small_text(Path(path), MAX_PRIOR_BYTES, "a prior file"), Path(path).name)

    @classmethod
    @checked
    def from_toml(cls, text: str, name: str = "prior") -> Prior:
        """Read the text of a prior file.

        Parameters
        ----------
        text
            The text.
        name
            Name of the file, for messages.

        Raises
        ------
        FrictrackError
            (usage) If the text is no prior; the message says what was expected.

        """
        try:
            return _prior(_File.model_validate(tomllib.loads(text)))
        except ValidationError as e:
            raise UsageError(f"{name}: {describe_invalid(e)}; `frictrack export STUDY --to prior` writes one") from e
        except FrictrackError as e:
            raise UsageError(f"{name}: {e}") from e
        except (ValueError, RecursionError) as e:
            raise UsageError(f"{name} is not valid TOML: {e}; export the law again") from e


def _prior(file: _File) -> Prior:
    """Return the prior of the tables of a file."""
    names = [one.name for one in file.parameter]
    matrix, std = np.eye(len(names)), np.array([one.std for one in file.parameter])
    for i, one in enumerate(file.parameter):
        if one.name in names[:i]:
            raise UsageError(f"expected every parameter once but got {one.name} twice")
        for other, r in one.correlation.items():
            if other not in names[:i]:
                raise UsageError(f'expected correlations of {one.name} with parameters above it but got "{other}"')
            matrix[i, names.index(other)] = matrix[names.index(other), i] = r
    return Prior(
        names=tuple(names),
        values=tuple(one.value for one in file.parameter),
        covariance=_rows(matrix * std * std[:, None]),
        units=tuple(one.unit for one in file.parameter),
        loaded=tuple(one.scales_with == "load" for one in file.parameter),
        load=file.prior.load,
        study=file.prior.study,
        model=tuple(file.prior.model),
    )


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    """Return a symmetric matrix as tuples."""
    even = (matrix + matrix.T) / 2
    return tuple(tuple(map(float, row)) for row in even)
