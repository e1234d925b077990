"""Why a YAML file cannot be read, in the words of all refusals."""

from __future__ import annotations

from yaml import MarkedYAMLError, YAMLError

UNREADABLE = (UnicodeDecodeError, YAMLError, OSError)
"""What reading a YAML file raises."""


def why_unreadable(error: Exception) -> str:
    """Return what is wrong with a file whose reading raised one of ``UNREADABLE``, with the line where there is one."""
    if isinstance(error, UnicodeDecodeError):
        return f"not UTF-8 (byte {error.start})"
    if isinstance(error, MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        return f"no YAML ({f'line {mark.line + 1}: ' if mark else ''}{error.problem})"
    why = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
    return f"cannot be read ({why})"
