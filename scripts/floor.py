"""The same as `mitsuba_bdpt.measure.floor`."""

import sys

from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.floor import main

if __name__ == "__main__":
    sys.exit(answered(main))
