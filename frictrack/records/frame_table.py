"""The base of records and results: columns with units, checked when a record is built; views for notebooks."""

from __future__ import annotations

from dataclasses import Field, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.base.lazy import imported

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure


class NotebookView:
    """Base of records and results that can be drawn; a notebook shows their line of text and their figure."""

    drawn_by: ClassVar[str]  # the function that draws it, "package.module:name"; it is imported when it is called

    def plot(self) -> Figure:
        """Draw it as a matplotlib figure."""
        figure: Figure = imported(self.drawn_by)(self)
        return figure

    def _repr_html_(self) -> str:
        page: str = imported("frictrack.present.plots:html")(self)
        return page

    def to_dataframe(self) -> pd.DataFrame:
        """Return it as a pandas DataFrame; ``attrs["units"]`` holds the units of the columns where they differ."""
        raise NotImplementedError

    def to_xarray(self) -> xr.Dataset:
        """Return it as an xarray Dataset, over the time ``t`` or over the rows of the DataFrame; needs xarray.

        Raises
        ------
        FrictrackError
            If xarray is not installed.

        """
        try:
            import xarray as xr  # noqa: PLC0415 - optional
        except ImportError as e:
            raise FrictrackError("to_xarray needs xarray; pip install xarray") from e
        frame = self.to_dataframe()
        dataset = xr.Dataset.from_dataframe(frame.set_index("t") if "t" in frame else frame)
        for name, unit in frame.attrs.get("units", {}).items():
            dataset[name].attrs["units"] = unit
        return dataset


Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def column(unit: str, *, nan: bool = False, kind: Any = np.float64, **options: Any) -> Any:
    """Declare a column of a record.

    Parameters
    ----------
    unit
        Unit of the values.
    nan
        Allow NaN, which means "not measured in this frame".
    kind
        NumPy type of the values.
    **options
        For `dataclasses.field`, for example a default.

    """
    return field(metadata={"unit": unit, "nan": nan, "column": True, "kind": kind}, **options)


def stretches(mask: Mask) -> list[slice]:
    """Return the slices of consecutive True in a mask (n,).

    Examples
    --------
    >>> stretches(np.array([True, True, False, True]))
    [slice(0, 2, None), slice(3, 4, None)]

    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def away_from_ends(mask: Mask, guard: int) -> Mask:
    """Return a mask (n,) without `guard` frames at the ends of each stretch; one of at most 3 `guard` is kept whole.

    Examples
    --------
    >>> away_from_ends(np.array([True, True, True, True, False, True]), 1).tolist()
    [False, True, True, False, False, True]

    """
    out = np.zeros(len(mask), dtype=bool)
    for one in stretches(mask):
        less = guard if one.stop - one.start > 3 * guard else 0
        out[one.start + less : one.stop - less] = True
    return out


def scalar(unit: str, **options: Any) -> Any:
    """Declare a number of a record, with its unit.

    Parameters
    ----------
    unit
        Unit of the number.
    **options
        For `dataclasses.field`.

    """
    return field(metadata={"unit": unit}, **options)


def _is_frozen(value: Any, kind: Any) -> bool:
    """Whether a value is an array of that type that nobody can change: it, and what it is a view of, are read-only."""
    if type(value) is not np.ndarray or value.dtype != kind:
        return False
    while isinstance(value, np.ndarray) and not value.flags["W"]:
        value = value.base
    return value is None


class FrameTable(NotebookView):
    """Base of the records with one row per frame; checks the columns when a record is built.

    All columns have the same length, are finite unless NaN is allowed, and become read-only; time rises.

    Raises
    ------
    FrictrackError
        If a column is wrong.

    """

    min_rows: ClassVar[int] = 2
    signals: ClassVar[tuple[str, ...]] = ()  # columns that a viewer draws against t, the first one above all
    drawn_by = "frictrack.present.plots:table"

    def __post_init__(self) -> None:
        faults: list[str] = []
        n = len(np.atleast_1d(np.asarray(self.t)))  # type: ignore[attr-defined]
        if n < self.min_rows:
            faults.append(f"expected at least {self.min_rows} frames but got {n}")
        for f in self._columns():
            faults += self._check_column(f.name, f.metadata, n)
        t = self.t  # type: ignore[attr-defined]
        if not faults and np.any(np.diff(t) <= 0):
            i = int(np.argmax(np.diff(t) <= 0))
            faults.append(f"expected rising time but got t[{i + 1}] = {t[i + 1]:g} s after t[{i}] = {t[i]:g} s")
        raise_faults(faults, type(self).__name__)

    def _columns(self) -> list[Field[Any]]:
        return [f for f in fields(self) if f.metadata.get("column")]  # type: ignore[arg-type]

    def _check_column(self, name: str, meta: Any, n: int) -> list[str]:
        value = getattr(self, name)
        if value is None:
            return []
        array = value if _is_frozen(value, meta["kind"]) else np.array(value, dtype=meta["kind"])
        if array.shape != (n,):
            return [f"expected {name} of shape ({n},) but got {array.shape}"]
        array.setflags(write=False)
        object.__setattr__(self, name, array)
        if array.dtype.kind == "f" and not meta["nan"] and not np.all(np.isfinite(array)):
            bad = int(np.argmin(np.isfinite(array)))
            return [f"expected finite {name} but got {array[bad]} at row {bad}"]
        return []

    def __len__(self) -> int:
        return len(self.t)  # type: ignore[attr-defined]

    def __repr__(self) -> str:
        name, t = getattr(self, "name", None) or getattr(self, "run", ""), self.t  # type: ignore[attr-defined]
        named = f' "{name}"' if name else ""
        ranges = [text for f in self._columns() if f.name != "t" and (text := self._range_text(f))]
        head = f"{type(self).__name__}{named}: {len(t)} frames, {t[0]:.6g} to {t[-1]:.6g} s"
        return f"<{'; '.join([head, *ranges])}>"

    def _range_text(self, f: Field[Any]) -> str:
        """Smallest and largest value of a numeric column with its unit; empty for others and where nothing is known."""
        values = getattr(self, f.name)
        if values is None or values.dtype.kind != "f" or not np.any(finite := np.isfinite(values)):
            return ""
        known = values[finite]
        low, high = f"{known.min():.4g}", f"{known.max():.4g}"
        return f"{f.name} {low if low == high else f'{low} to {high}'} {f.metadata['unit']}"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the columns as a pandas DataFrame, one row per frame; ``attrs["units"]`` holds their units.

        Examples
        --------
        >>> from frictrack.records import Displacement
        >>> nan = np.full(2, np.nan)
        >>> seen = Displacement([0, 1], [0, 0.5], nan, nan, nan, nan, [True, True])
        >>> seen.to_dataframe()["x"].tolist(), seen.to_dataframe().attrs["units"]["x"]
        ([0.0, 0.5], 'm')

        """
        import pandas as pd  # noqa: PLC0415 - half a second

        known = [f for f in self._columns() if getattr(self, f.name) is not None]
        frame = pd.DataFrame({f.name: getattr(self, f.name) for f in known})
        frame.attrs["units"] = {f.name: f.metadata["unit"] for f in known}
        return frame

    def rows(self, part: slice) -> Self:
        """Return the record with some of its rows; at least two remain."""
        columns = {f.name: getattr(self, f.name) for f in self._columns()}
        return replace(self, **{name: q[part] for name, q in columns.items() if q is not None})  # type: ignore[type-var]
