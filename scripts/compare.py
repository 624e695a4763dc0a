"""Two ways to render, alternating: ``python -m mitsuba_bdpt compare``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("compare"))
