"""Write the pages of frictrack: the report of a study, of a batch of studies, and of a plan of runs.

from frictrack.present import report
page = report.write(results, Path("report.html"))
report.print_pdf(page)  # report.pdf
"""

from frictrack.present.report.campaign_page import write_campaign
from frictrack.present.report.markup import SvgEmbedder, mark_code, mark_equation, page_template
from frictrack.present.report.measurement_quality import failed_checks, is_good
from frictrack.present.report.page import render, write
from frictrack.present.report.pdf import print_pdf
from frictrack.present.report.plan_page import write_plan
from frictrack.present.report.tables import CandidateCard, candidate_cards, inseparable, separating_experiments
from frictrack.present.report.verdict_text import study_verdict

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
