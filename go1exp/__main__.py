"""``python -m go1exp``: the command line where the script ``go1exp`` is not installed."""

import sys

from go1exp.cli import main

if __name__ == "__main__":
    sys.exit(main())
