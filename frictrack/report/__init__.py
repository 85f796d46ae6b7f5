"""Write the pages of frictrack: the report of a study, of a batch of studies, and of a plan of runs.

from frictrack import report
page = report.write(results, Path("report.html"))
report.print_pdf(page)  # report.pdf
"""

from frictrack.report.campaign_page import write_campaign
from frictrack.report.markup import mark_code, mark_equation
from frictrack.report.page import render, write
from frictrack.report.pdf import print_pdf
from frictrack.report.plan_page import write_plan
from frictrack.report.templates import SvgEmbedder, page_template

__all__ = [
    "SvgEmbedder",
    "mark_code",
    "mark_equation",
    "page_template",
    "print_pdf",
    "render",
    "write",
    "write_campaign",
    "write_plan",
]
