"""Photons: light subpaths traced before the samples and kept in memory, and what is done with them.

`photon_pass` traces them. `merging` merges camera vertices with them (vertex merging, photon mapping), within
`merge_radius`. `photon_guide` makes of them a density of directions, from which `guided_hits` samples
(photon-guided BSDF sampling); `guiding_benefit` predicts what that gains. `aim` chooses their first
directions. All of them serve SDS paths: specular-diffuse-specular paths, which no connection can make.
"""
