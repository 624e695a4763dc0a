"""Instruments that look into renders, for tests, stress cases and scripts; the package needs none of them.

* `oracle`: the densities of all strategies of a path, written out; `endpoints`: the densities of emitters and
  cameras in closed form.
* `capture`: paths that the kernel makes, and whether their weights are those of densities; `chains`: random
  densities, and the weights by the recursion.
* `recording`: retraces large samples of a render vertex by vertex; `reconstruct`: finds a recorded path again
  with Mitsuba's calls; `fireflies`: both, as a table.
* `floor`: kernel time over that of the rays alone.
"""
