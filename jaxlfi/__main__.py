"""`python -m jaxlfi` is the command line."""

import sys

from jaxlfi.cli.parser import main

sys.exit(main())
