"""Reports of a comparison: one HTML page, a JSON file, and a summary for the terminal."""

from go1exp.gap.report.page import write_report
from go1exp.gap.report.terminal import localisation_text, text

__all__ = ["localisation_text", "text", "write_report"]
