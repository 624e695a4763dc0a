"""The paths behind the worst values: ``python -m mitsuba_bdpt fireflies``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("fireflies"))
