"""Instruments that look into renders, for tests, stress cases and scripts; the package needs none of them.

* `oracle`: the densities of all strategies of a path, written out; `endpoints`: the densities of emitters and
  cameras in closed form.
* `capture`: paths that the kernel makes, and whether their weights are those of densities; `chains`: random
  densities, and the weights by the recursion.
* `floor`: kernel time over that of the rays alone.
"""
