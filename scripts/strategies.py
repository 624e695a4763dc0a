"""The technique pyramid of a scene: ``python -m mitsuba_bdpt pyramid``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("pyramid"))
