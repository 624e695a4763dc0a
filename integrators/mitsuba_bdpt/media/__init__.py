"""Participating media: tables, free flight, transmittance between two points. A component.

Measures: surface vertices are in the area measure, volume vertices in the volume measure. Free flight samples
the density sigma_t T of collisions, so that a walk multiplies by the albedo sigma_s / sigma_t alone; only
connections evaluate the transmittance T. Every strategy of a path samples each of its volume vertices once,
and every edge but the connecting one: of these densities the MIS weights keep 1 / T of the connecting edge
(M. Raab, D. Seibert, A. Keller 2008; J. Křivánek et al. 2014, "Unifying Points, Beams, and Paths in
Volumetric Light Transport Simulation", supplemental document).

The weights use ``T~`` in place of T, a function of the edge alone that all strategies share: the estimate
stays unbiased, since weights add up to 1 for each path. A random estimate of T would not do.

An *edge* connects two vertices; null surfaces and null collisions on it are no vertices, but cut it into
*segments*.
"""

from .prepared import prepare

__all__ = ["prepare"]
