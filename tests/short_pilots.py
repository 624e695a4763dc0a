"""Pilots run from `PILOTED` samples on once this is imported.

Tests and stress cases of longer renders would cost more.
"""

from mitsuba_bdpt.planning import budget

LEAST_SAMPLES, PILOTED = budget.LEAST_SAMPLES, 1 << 14

budget.LEAST_SAMPLES = PILOTED
