"""Checks whether a recording can be compared with a simulation: clock, sensors, order, signs and units."""

from go1exp.audit.checks import audit, audit_file
from go1exp.audit.report import AuditReport, Channel, Finding, Verdict

__all__ = ["AuditReport", "Channel", "Finding", "Verdict", "audit", "audit_file"]
