"""Reports of protocols and of comparisons: one HTML page without anything beside it, and its drawings."""

from __future__ import annotations
