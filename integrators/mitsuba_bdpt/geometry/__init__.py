"""Shapes: origins and ends of rays, rounding of hits, Mitsuba's sampling choices.

Rays start and end in `rays` alone, by the errors in `rounding`. `quadrics`, `smooth_meshes` and `to_world`
replicate how Mitsuba samples points of shapes; `mitsubas_choices` lists and checks these choices.
"""
