"""``python -m mitsuba_bdpt``: the command, see `cli.arguments`."""

import sys

from .cli.arguments import main

if __name__ == "__main__":
    sys.exit(main())
