"""How long a test waits for what another process or thread does."""

PATIENCE = 1800
"""Seconds; only what hangs takes so long, also where other work has the processors."""
