"""Photons: stored vertices of light subpaths traced before the samples, for SDS paths.

`photon_pass` traces them, with first directions by `aim`. The component `merging` merges camera vertices with
them; `photon_guide` builds a density of directions from them, from which `guided_hits` samples.
"""
