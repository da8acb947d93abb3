"""``python -m depthba`` is the command ``depthba``."""

import sys

from depthba.cli import main

sys.exit(main())
