"""Reference images: ``python -m mitsuba_bdpt reference``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("reference"))
