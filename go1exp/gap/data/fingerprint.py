"""Recordings by their content."""

from __future__ import annotations

import hashlib

import numpy as np

from go1exp.logs.recording import Recording


def fingerprint(recording: Recording) -> str:
    """Return a SHA-256 over a recording's columns, independent of how a file packs them."""
    digest = hashlib.sha256()
    for name in sorted(recording.channels):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(recording.channels[name]).tobytes())
    return digest.hexdigest()
