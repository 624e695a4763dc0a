"""Pilots run from `PILOTED` samples on once this is imported.

Tests and stress cases of longer renders would cost more.
"""

from mitsuba_bdpt.planning import budget

FOCUSED_SAMPLES, LEAST_SAMPLES, PILOTED = budget.FOCUSED_SAMPLES, budget.LEAST_SAMPLES, 1 << 14

budget.FOCUSED_SAMPLES = budget.LEAST_SAMPLES = PILOTED
