"""The report: all that a study has come to on one self-contained HTML page.

from frictrack import report
page = report.write(results, Path("report.html"))
report.printed(page)  # report.pdf
"""

from frictrack.report.page import render, write
from frictrack.report.pdf import printed

__all__ = ["printed", "render", "write"]
