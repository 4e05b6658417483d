"""`python -m petrobot` is the `petrobot` command."""

import sys

from petrobot.coordinator.cli import main

sys.exit(main())
