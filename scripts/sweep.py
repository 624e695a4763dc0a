"""Sweeps of run time against error: ``python -m mitsuba_bdpt sweep``, in this repository.

With one more probe, ``floor``: kernel time over that of its rays alone.
"""

import sys

import floor
from mitsuba_bdpt.measure.probes import PROBES
from repository import verb

if __name__ == "__main__":
    PROBES["floor"] = floor.probe
    sys.exit(verb("sweep"))
