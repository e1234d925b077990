"""Reports of a comparison: one HTML page, a JSON file, and a summary for the terminal."""

from go1exp.gap.report.page import localisation_text, text, write_report

__all__ = ["localisation_text", "text", "write_report"]
