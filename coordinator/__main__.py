"""`python -m coordinator` is the `petrobot` command."""

import sys

from coordinator.cli import main

sys.exit(main())
