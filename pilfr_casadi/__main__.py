"""The command line as `python -m pilfr_casadi`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
