"""Where the package keeps its configuration and its data."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def data_root() -> Path:
    """Folder that holds ``conf/`` and ``assets/``: the package itself in a wheel, the repository root in a checkout.

    The repository root counts only with its ``pyproject.toml``, so a stranger's ``conf/`` in site-packages never does.
    """
    if (_PACKAGE / "conf").is_dir():
        return _PACKAGE
    root = _PACKAGE.parent
    if (root / "conf").is_dir() and (root / "pyproject.toml").is_file():
        return root
    raise FileNotFoundError(f"go1exp: no conf/ in {_PACKAGE} and no checkout around it")
