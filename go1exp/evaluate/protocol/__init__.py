"""Protocols: what robots are told and done to, what is measured, what counts as reached (``conf/protocol``)."""

from __future__ import annotations
