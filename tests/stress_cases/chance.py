"""Examples of hypothesis that are the same in every run."""

from collections.abc import Callable

from hypothesis import HealthCheck, Phase, given, settings


def by_chance(strategy, function: Callable, examples: int) -> None:
    """Call ``function`` with examples of a ``strategy``."""
    settled = settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    settled(given(strategy)(function))()
