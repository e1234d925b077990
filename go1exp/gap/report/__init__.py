"""What a reader sees of a comparison: one HTML file, the same as JSON, and a few lines for the terminal."""

from go1exp.gap.report.html import write_report
from go1exp.gap.report.terminal import localisation_text, text

__all__ = ["localisation_text", "text", "write_report"]
