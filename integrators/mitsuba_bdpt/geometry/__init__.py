"""Shapes: where rays start and end on them, how hits round, and what Mitsuba's samplers do on them.

`rays` is the one place where rays start and end, by the errors that `rounding` states. `quadrics`,
`smooth_meshes` and `to_world` know how Mitsuba samples points of shapes; `mitsubas_choices` lists these
choices and checks them.
"""
