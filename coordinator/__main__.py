"""`python -m petrobot.coordinator` is `python -m petrobot`."""

import sys

from petrobot.coordinator.cli import main

sys.exit(main())
