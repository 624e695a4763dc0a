"""A sweep as one HTML file: ``python -m mitsuba_bdpt page``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("page"))
