"""Checks whether a recording can be compared with a simulation: clock, sensors, order, signs and units."""

from go1exp.logs.audit.checks import audit, clock_flaws, clock_kinds
from go1exp.logs.audit.report import AuditReport, Channel, Finding, Verdict

__all__ = ["AuditReport", "Channel", "Finding", "Verdict", "audit", "clock_flaws", "clock_kinds"]
