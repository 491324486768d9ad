"""``python -m warp_gi.bench`` is ``warp-gi bench``."""

import sys

from warp_gi.cli.main import main

sys.exit(main(["bench", *sys.argv[1:]]))
