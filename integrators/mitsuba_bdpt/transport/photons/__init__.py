"""Photons: stored vertices of light subpaths traced before the samples.

`photon_pass` traces them. The component `merging` merges camera vertices with them (vertex merging, photon
mapping). `photon_guide` builds a density of directions from them, from which `guided_hits` samples
(photon-guided BSDF sampling). `aim` samples their first directions. All serve SDS paths
(specular-diffuse-specular), which no connection can sample.
"""
