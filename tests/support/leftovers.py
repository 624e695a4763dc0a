"""What a test leaves behind in the process."""

import gc

from mitsuba_bdpt.host.jit import registered_emitters


def collect(before: list[str]) -> None:
    """Free the scenes of a test, if there are other emitters than ``before``, see `registered_emitters`.

    An exception that a test keeps, or failed with, keeps the test's scenes until the cycle collector runs, at
    any time, and calls of later tests visit their emitters.
    """
    if registered_emitters() != before:
        gc.collect()
