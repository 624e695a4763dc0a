"""The door for tools that look inside of a kernel."""

from __future__ import annotations


class Observer:
    """Is shown what the subpaths of a lane do while they are recorded; this one does nothing.

    `kernel.retrace` takes one. What it is given are arrays of Dr.Jit, which it must not change. In recorded
    loops they have no values yet; who wants to read them turns `SymbolicLoops` and `SymbolicConditionals`
    off, so that loops run step by step. Lanes whose subpath has ended keep the values of their last step,
    with ``active`` false.
    """

    def emitted(self, emission):
        """A light subpath starts: y_0 and the direction of its first edge, an `emitters.Emission`."""

    def started(self, kernel, side, walk, stream):
        """A subpath is on its first edge; ``side`` is its `walk.Side`, ``stream`` its random numbers."""

    def vertex(self, side, walk, vertex, step):
        """A subpath has reached a ``vertex`` (`walk.Vertex`) and sampled the next ``step``.

        ``step`` is a `bsdf.Step`, None in scenes without surfaces; ``walk`` as it was before it arrived.
        """

    def drawn(self, end):
        """One inner connection of a camera vertex was drawn.

        ``end``: the light vertex, or where a visibility ray ends that is to reach it.
        """
