"""Variants of Mitsuba that the tests use: of LLVM, or of CUDA where BDPT_TEST_BACKEND=cuda is set.

Tests of images ask here, so that they can be tried on a GPU; others name LLVM where they need it.
"""

import os

BACKEND = os.environ.get("BDPT_TEST_BACKEND", "llvm")


def of(colour: str) -> str:
    """The variant of the tests' backend with colours as ``rgb``, ``mono`` or ``spectral``."""
    return f"{BACKEND}_ad_{colour}"
