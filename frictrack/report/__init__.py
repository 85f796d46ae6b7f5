"""Write the pages of frictrack: the report of a study, of a batch of studies, and of a plan of runs.

from frictrack import report
page = report.write(results, Path("report.html"))
report.print_pdf(page)  # report.pdf
"""

from frictrack.report.campaign_page import write_campaign
from frictrack.report.markup import SvgEmbedder, mark_code, mark_equation, page_template
from frictrack.report.measurement_quality import failed_checks, is_good
from frictrack.report.page import render, write
from frictrack.report.pdf import print_pdf
from frictrack.report.plan_page import write_plan
from frictrack.report.tables import CandidateCard, candidate_cards, inseparable, separating_experiments
from frictrack.report.verdict_text import study_verdict

__all__ = [
    "CandidateCard",
    "SvgEmbedder",
    "candidate_cards",
    "failed_checks",
    "inseparable",
    "is_good",
    "mark_code",
    "mark_equation",
    "page_template",
    "print_pdf",
    "render",
    "separating_experiments",
    "study_verdict",
    "write",
    "write_campaign",
    "write_plan",
]
