"""Light endpoints: sampling of emitters, and the densities of it.

Mitsuba offers no or wrong densities of emission: no density of ``sample_ray``, ``pdf_position`` raises for
all emitters and ``eval_direction`` for some, a rotated ``envmap`` emits from the wrong disk, and projectors,
spots and directional emitters have no density of directions. Bidirectional weights need these densities for
points made by other strategies. Emission is therefore sampled here, on top of the calls that are right:
``sample_direction``, ``pdf_direction``, ``eval`` and the shapes' ``sample_position``.
`geometry.mitsubas_choices` lists replacements where these are wrong too.

`emitters.Emitters` selects an emitter and dispatches to its group (a `group.Group`, of the modules area,
directional_area, position and infinite; hit-only in group, user-defined classes in kinds). A new kind of
emitter is such a module, or a line in an existing one, and a line in `kinds.KINDS`.

The density of an emission has two factors:

* ``pdf_first`` of y_0: area measure on a surface; 1 for a point light (times its selection); solid angle of
  the direction for an emitter at infinity (1 for a directional one).
* ``pdf_second`` of y_1 given y_0: solid angle (1 for the fixed direction of a directional area); for an
  emitter at infinity the area density across the direction: 1 / (pi R^2) on the disk that covers the scene,
  or a mixture of it and a disk that covers the scene's details.

Suffix ``_a``: density over area; ``_w``: over solid angle. Next-event estimation has its own density of y_0,
which depends on the lit vertex (cones of spheres, d^2 / cos, environments).
"""
