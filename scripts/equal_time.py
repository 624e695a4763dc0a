"""Integrators side by side at equal time: ``python -m mitsuba_bdpt equal-time``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("equal-time"))
