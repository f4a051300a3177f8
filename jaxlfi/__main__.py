"""`python -m jaxlfi` is the command line."""

import sys

from jaxlfi.cli.start import main

sys.exit(main())
