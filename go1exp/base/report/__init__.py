"""One kit for all reports: a page from one template, tables, figures as SVG, numbers and intervals as text."""
