"""Tables and plots of a sweep: ``python -m mitsuba_bdpt report``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("report"))
