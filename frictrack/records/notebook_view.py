"""The base of records and results: what a notebook shows of them, and how they become tables of other libraries."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from frictrack.errors import FrictrackError
from frictrack.lazy import imported

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
        page: str = imported("frictrack.plots:html")(self)
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
