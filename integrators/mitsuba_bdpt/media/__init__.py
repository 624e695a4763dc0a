"""Participating media: which there are, flights along an edge, transmittance between two points.

Measures. Vertices on surfaces are in the area measure, vertices in a medium in the volume measure. Free
flight is sampled with the density sigma_t T of collisions (analogously), so that a walk multiplies by the
albedo sigma_s / sigma_t alone and evaluates no transmittance T; that stands in joins only. Every strategy
that makes a path samples each of its volume vertices once, and every edge but the one that it joins: of all
these densities the weights of multiple importance sampling keep 1 / T of the joining edge (M. Raab, D.
Seibert, A. Keller 2008; J. Křivánek et al. 2014, "Unifying Points, Beams, and Paths in Volumetric Light
Transport Simulation", supplemental document).

In the weights T is replaced by ``T~``, a function of the edge alone which every strategy has to agree on: any
such function leaves the estimate unbiased, as weights add up to 1 for each path. A random estimate of T does
not.

An *edge* joins two vertices; null surfaces and null collisions in between are no vertices: they cut it into
*segments*.
"""
