"""The same as `mitsuba_bdpt.measure.compare`."""

import sys

from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.compare import main

if __name__ == "__main__":
    sys.exit(answered(main))
