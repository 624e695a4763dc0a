"""Snapshots of renders that are stopped, for tests of what goes on from them."""

from mitsuba_bdpt.run.snapshot import Snapshot

# Sums of a pass are made by atomic additions, whose order differs from run to run.
ROUNDING = {"rtol": 2e-4, "atol": 1e-6}


def stopped(integrator, target, after: int | None, **arguments) -> Snapshot:
    """The snapshot of a render that is stopped after so many passes, or that is whole, through a file's
    bytes and back."""
    reports = []

    def on_pass(report):
        reports.append(report)
        if len(reports) == after:
            integrator.cancel()

    integrator.on_pass = on_pass
    integrator.render(target, develop=False, **arguments)
    integrator.on_pass = None
    return Snapshot.from_bytes(reports[-1].snapshot().to_bytes())
