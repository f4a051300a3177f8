"""`python -m jaxlfi` is the command line."""

import sys

from jaxlfi.cli import main

sys.exit(main())
