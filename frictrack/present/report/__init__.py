"""Write the pages of frictrack: the report of a study, of a batch of studies, and of a plan of runs.

from frictrack.present import report
page = report.write(results, Path("report.html"))
report.print_pdf(page)  # report.pdf
"""
# ruff: noqa: F401 - the imports are the interface

from frictrack.present.report.page import print_pdf, render, write, write_campaign, write_plan
from frictrack.present.report.tables import SvgEmbedder, mark_code, mark_equation, page_template
from frictrack.present.report.texts import failed_checks, is_good, study_verdict
