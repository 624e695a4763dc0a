"""Sweeps of run time against error: ``python -m mitsuba_bdpt sweep``, in this repository."""

import sys

from repository import verb

if __name__ == "__main__":
    sys.exit(verb("sweep"))
