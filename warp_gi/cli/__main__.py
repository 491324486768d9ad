"""``python -m warp_gi.cli`` is ``warp-gi``."""

import sys

from warp_gi.cli.main import main

sys.exit(main())
