"""``python -m warp_gi.bench.publish``."""

from warp_gi.bench.publish.command import main

raise SystemExit(main())
