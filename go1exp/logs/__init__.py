"""Recordings: format, importers, audit, and how they are made."""
