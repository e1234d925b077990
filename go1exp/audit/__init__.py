"""Is a recording fit to be compared with a simulation? Clock, sensors, order, signs and units, judged one by one."""

from go1exp.audit.checks import audit, audit_file
from go1exp.audit.report import AuditReport, Channel, Finding, Verdict

__all__ = ["AuditReport", "Channel", "Finding", "Verdict", "audit", "audit_file"]
