"""The report: all that a study has come to on one self-contained HTML page.

from frictrack import report
report.write(results, Path("report.html"))
"""

from frictrack.report.page import render, write

__all__ = ["render", "write"]
