"""Light endpoints: how emitters are sampled, and with which densities.

Why there are formulas here at all: Mitsuba has no densities of emission, or wrong ones. Its emitters offer no
density of ``sample_ray``, ``pdf_position`` throws for all of them and ``eval_direction`` for some, a rotated
``envmap`` emits from the wrong disk, and projectors, spots and directional emitters state no density of
directions. A bidirectional weight needs all of these for points that other strategies have made. So emission
is sampled here, by formulas on top of the calls that are right: ``sample_direction``, ``pdf_direction``,
``eval`` and the shapes' ``sample_position``; where these are wrong too (small spheres, turned spheres, some
textures), `geometry.mitsubas_choices` says what is done in their place.

`emitters.Emitters` selects an emitter and asks the group that it belongs to (`group.Group`: area, directional
area, position, infinite, hit-only, third-party), one module each, all views of its density together. A new
kind of emitter is one such module, or a line for an existing one, and a line in the table `kinds.KINDS`.

Densities of an emission are two factors, in this order:

* ``pdf_first`` of y_0: area measure on a surface; 1 for a point light (times its selection); solid angle of
  the direction for an emitter at infinity (1 for a directional one).
* ``pdf_second`` of y_1 given y_0: solid angle (1 for the fixed direction of a directional area); for an
  emitter at infinity the area density across the direction: 1 / (pi R^2) on the disk that covers the scene,
  or a mixture of that and a disk that covers its details.

Names that end in ``_a`` are densities over area, in ``_w`` over solid angle. Next-event estimation has its
own density of y_0, which depends on the vertex that is lit (cones of spheres, d^2 / cos, environments).
"""
