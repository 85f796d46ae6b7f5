"""Make runs of arrays and tables: checked clock, outliers left out, noise estimated, velocity and acceleration.

even_table   sampled positions -> displacement on an even clock
runs         arrays or a DataFrame -> a run
"""

from frictrack.arrays.even_table import EvenTable, displacement_of_table, jitter_notes, with_even_clock
from frictrack.arrays.runs import run_of_arrays, run_of_dataframe

__all__ = [
    "EvenTable",
    "displacement_of_table",
    "jitter_notes",
    "run_of_arrays",
    "run_of_dataframe",
    "with_even_clock",
]
