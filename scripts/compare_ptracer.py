"""Where Mitsuba's own light tracer, `ptracer`, is wrong: a number for each case beside the right one.

    python scripts/compare_ptracer.py                    # prints the table
    python scripts/compare_ptracer.py --page docs/reports/ptracer.md

The right number is Mitsuba's `path` where that can see the light, else a closed form; both light tracers
render the same scene with the same depth. ``--page`` fills the part of a Markdown file between
`<!-- report: ptracer -->` and `<!-- end -->`. The exit status is 1 if `bdpt` is off in a case, or `ptracer`
is not.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import command_line
import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.measure.tables import replace_part, table

import mitsuba as mi  # isort: skip

RENDERS = 8
SPP = 256  # at `SIZE`; `path` has `FINER` times as many
FINER = 4
SIZE = 32
RIGHT = 0.02  # relative: `bdpt` must be nearer to the right number, `ptracer` is wrong if it is farther


@dataclass(frozen=True)
class Case:
    """A scene that both integrators render.

    ``name`` (Markdown); ``scene`` makes it, depth ``depth`` and the parameters of both integrators.
    ``right``: the known value, None: from `path`, which renders the scene ``equal`` instead where it is wrong
    about the first. ``measure`` makes a number of an image and `path`'s; ``what`` names it. ``errors``: the
    number is an error, 0 where all is right, and ``limit`` what noise makes of it.
    """

    name: str
    scene: Callable
    depth: int = 4
    right: float | None = None
    equal: Callable | None = None
    measure: Callable = lambda image, reference: image.mean()
    what: str = "mean radiance"
    parameters: dict = field(default_factory=dict)
    variant: str = "llvm_ad_rgb"
    errors: bool = False
    limit: float = 0.05


@dataclass(frozen=True)
class Row:
    """What was found: ``right``, ``ours``; ``theirs`` None if `ptracer` refuses."""

    case: Case
    right: float
    theirs: float | None
    ours: float

    def off(self, value) -> bool:
        """Whether a number is not the right one."""
        if value is None:
            return True
        return abs(value - self.right) > (self.case.limit if self.case.errors else RIGHT * self.right)


# -- scenes -----------------------------------------------------------------------------------


def transform():
    return mi.ScalarTransform4f()


def grey(value):
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}
    return {"type": "twosided", "bsdf": bsdf}


def film(size=SIZE, rfilter="box", **keys):
    return {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": rfilter},
    } | keys


def sensor(kind="perspective", film_keys=None, **keys):
    placed = {}
    if kind in ("perspective", "thinlens", "orthographic"):
        placed["to_world"] = transform().look_at([0, 2, 5], [0, 0.4, 0], [0, 1, 0])
    if kind in ("perspective", "thinlens"):
        placed["fov"] = 40
    return (
        placed | {"type": kind, "film": film(**(film_keys or {})), "sampler": {"type": "independent"}} | keys
    )


def floor(bsdf=None, scale=2.0):
    return {
        "type": "rectangle",
        "bsdf": bsdf or grey(0.6),
        "to_world": transform().rotate([1, 0, 0], -90).scale(scale),
    }


def lamp(radiance=8.0, **keys):
    """A square lamp above the floor."""
    return {
        "type": "rectangle",
        "bsdf": grey(0.0),
        "to_world": transform().translate([0.4, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.5),
        "emitter": {"type": "area", "radiance": radiance},
    } | keys


def sheet():
    """A sheet that lets half of the light pass on either of its faces, before a white sky."""
    eye = transform().look_at([0, 0, 6], [0, 0, 3], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "sensor": sensor(to_world=eye, fov=20),
            "sheet": {
                "type": "cube",
                "to_world": transform().translate([0, 0, 3]).scale([1, 1, 1.5e-4]),
                "bsdf": {"type": "mask", "opacity": 0.5, "inner": grey(0.0)},
            },
        }
    )


def round_lamp(turned):
    """A lamp on a sphere, which no turn changes."""
    placed = transform().translate([0.4, 2.2, 0]).scale(0.3)
    if turned:
        placed = placed.rotate([0.6, 0, 0.8], 100)
    return {
        "type": "sphere",
        "to_world": placed,
        "bsdf": grey(0.0),
        "emitter": {"type": "area", "radiance": 8.0},
    }


def ball(bsdf=None, **keys):
    shape = {"type": "sphere", "center": [-0.5, 0.6, 0.2], "radius": 0.5}
    return shape | {"bsdf": bsdf or {"type": "roughplastic", "alpha": 0.3}} | keys


def scene(seen=None, **parts):
    """A floor and a ball, and what the case adds or replaces."""
    whole = {"type": "scene", "sensor": seen or sensor(), "floor": floor(), "ball": ball()} | parts
    return mi.load_dict({key: part for key, part in whole.items() if part is not None})


def bitmap(values, **keys):
    image = mi.Bitmap(np.asarray(values, dtype=np.float32))
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "nearest"} | keys


def sky(**keys):
    """An environment with one bright patch."""
    values = np.full((8, 16, 3), 0.3, dtype=np.float32)
    values[2, 3] = 8.0
    return {"type": "envmap", "bitmap": mi.Bitmap(values)} | keys


def bumps():
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    height = 0.5 + 0.15 * (np.sin(6 * x) + np.sin(5 * y) + np.sin(3 * x + 4 * y))
    texture = bitmap(height[..., None], filter_type="bilinear")
    return {"type": "twosided", "bsdf": {"type": "bumpmap", "height": texture, "scale": 0.5, "bsdf": matte()}}


def normals():
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    n = np.stack([0.5 * np.sin(4 * x), 0.5 * np.sin(3 * y), np.ones_like(x)], axis=-1)
    n = (n / np.linalg.norm(n, axis=-1, keepdims=True) + 1) / 2
    texture = bitmap(n, filter_type="bilinear")
    return {"type": "twosided", "bsdf": {"type": "normalmap", "normalmap": texture, "bsdf": matte()}}


def matte():
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7] * 3}}


def low_spot():
    """Light that grazes the floor."""
    place = transform().look_at([1.8, 0.9, 1.2], [0, 0, 0], [0, 1, 0])
    return {"type": "spot", "intensity": 10.0, "cutoff_angle": 50, "beam_width": 40, "to_world": place}


def meter():
    """A plate that measures the irradiance under the lamp."""
    place = transform().translate([0.4, 0.2, 0.9]).rotate([1, 0, 0], -90).scale(0.2)
    return {
        "type": "rectangle",
        "to_world": place,
        "sensor": sensor("irradiancemeter", {"size": 1}),
    }


def furnace(**seen):
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(**seen),
            "sky": {"type": "constant", "radiance": 1.0},
            "ball": ball(),
        }
    )


def moved_floor():
    """A floor that has grown after the scene was loaded."""
    made = scene(ball=None, floor=floor(scale=0.3), lamp={"type": "directional", "direction": [0, -1, 0.2]})
    parameters = mi.traverse(made)
    parameters["floor.to_world"] = mi.Transform4f(transform().rotate([1, 0, 0], -90).scale(2))
    parameters.update()
    return made


def closed_room(radiance):
    """Inside of a ball of reflectance 0.9 that a small ball lights."""
    inside = transform().look_at([0, 0, 0.6], [0, 0, -1], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(to_world=inside, fov=60),
            "wall": {"type": "sphere", "flip_normals": True, "bsdf": grey(0.9)["bsdf"]},
            "lamp": {
                "type": "sphere",
                "center": [0, 0.4, 0],
                "radius": 0.2,
                "bsdf": grey(0.0),
                "emitter": {"type": "area", "radiance": radiance},
            },
        }
    )


def cube_lamp(radiance):
    return {
        "type": "cube",
        "to_world": transform().translate([0.8, 1.4, 0.3]).rotate([0, 1, 0], 30).scale(0.3),
        "bsdf": grey(0.0),
        "emitter": {"type": "area", "radiance": radiance},
    }


LENS = 0.05
POINT_DISTANCE = 2.0


def point_before_a_lens():
    place = transform().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    seen = sensor("thinlens", to_world=place, fov=50, aperture_radius=LENS, focus_distance=3.0)
    point = {"type": "point", "position": [0, 0, POINT_DISTANCE], "intensity": 2.0}
    return mi.load_dict({"type": "scene", "sensor": seen, "lamp": point})


# I / d^2 over the film's area at distance 1; the mean of 1 / cos^3 / d^2 over so small a lens adds 6e-5.
POINT_SEEN = 2.0 / POINT_DISTANCE**2 / (2 * np.tan(np.deg2rad(25))) ** 2


def blocker():
    """A disk between the pinhole and the near plane: camera rays start behind it."""
    place = transform().look_at([0, 1.84, 4.5], [0, 2, 5], [0, 1, 0]).scale(0.12)
    return {"type": "disk", "bsdf": grey(0.0), "to_world": place}


def hidden_lamp():
    """A ball of light in front of a box. (No ball behind it: `path` shades those at a wrong place.)"""
    place = transform().translate([0.1, 1.2, 2.6]).scale(0.5)
    box = transform().translate([-0.5, 0.5, 0]).rotate([0, 1, 0], 30).scale(0.4)
    return scene(
        ball=None,
        box={"type": "cube", "bsdf": grey(0.5), "to_world": box},
        lamp=lamp() | {"type": "sphere", "to_world": place},
    )


def behind_hidden_lamp(near_clip=0.01):
    """A ball of light in front of another ball; or before the near plane, where no camera ray meets it."""
    return scene(
        sensor(near_clip=near_clip),
        ball=ball(center=[0, 0.6, 0], radius=0.6),
        lamp=lamp() | {"type": "sphere", "to_world": transform().translate([0, 1.2, 2.6]).scale(0.5)},
    )


def tile_error(image, reference):
    """Root mean square of the relative differences of 8 x 8 tiles."""

    def means(x):
        return x.reshape(8, x.shape[0] // 8, 8, x.shape[1] // 8, -1).mean((1, 3, 4))

    a, b = means(image), means(reference)
    lit = b > 0.05 * b.max()
    return float(np.sqrt(np.mean((a[lit] / b[lit] - 1) ** 2)))


def frame_mean(image, reference):
    """Mean of the outermost pixels."""
    inner = image[1:-1, 1:-1].sum()
    return float((image.sum() - inner) / (image.size - image[1:-1, 1:-1].size))


def alpha(image, reference):
    return image[..., 3].mean()


def tiny(scale):
    """A ball that nearly touches the floor, at a scale."""
    s = transform().scale(scale)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(
                to_world=transform().look_at([0, 2 * scale, 5 * scale], [0, 0.4 * scale, 0], [0, 1, 0]),
                near_clip=0.01 * scale,
                far_clip=100 * scale,
            ),
            "floor": floor() | {"to_world": s @ floor()["to_world"]},
            "ball": {"type": "sphere", "to_world": s @ transform().translate([-0.5, 0.6, 0.2]).scale(0.5)},
            "lamp": lamp() | {"to_world": s @ lamp()["to_world"]},
        }
    )


CASES = [
    Case(
        "`envmap` with a rotated `to_world`: it emits from a disk that is not turned with the light",
        lambda: scene(lamp=sky(to_world=transform().rotate([1, 0, 0], 80))),
    ),
    Case("`orthographic`: no `sample_direction`", lambda: scene(sensor("orthographic"), lamp=lamp())),
    Case(
        "`distant`: no `sample_direction`",
        lambda: scene(sensor("distant", {"size": 1}, direction=[-0.3, -0.8, -0.5]), lamp=lamp()),
    ),
    Case("`irradiancemeter`: the weight ignores the density", lambda: scene(meter(), lamp=lamp())),
    Case(
        "`thinlens` focused beyond its far plane (at it, which is the default, rounding decides): no film "
        "position is valid",
        lambda: scene(
            sensor("thinlens", aperture_radius=0.02, far_clip=15.0, focus_distance=20.0), lamp=lamp()
        ),
    ),
    Case(
        "`perspective` with `principal_point_offset_x` = 0.3: part of the film is dark",
        lambda: scene(sensor(principal_point_offset_x=0.3), lamp=lamp()),
    ),
    Case(
        "`gaussian` filter, white furnace, outermost pixels: splats lose what falls beside the film",
        lambda: furnace(film_keys={"rfilter": "gaussian"}),
        measure=frame_mean,
        what="mean radiance of the frame",
    ),
    Case(
        "bump map in grazing light: the correction is for vertex normals",
        lambda: scene(ball=None, floor=floor(bumps()), lamp=low_spot()),
        depth=2,
        measure=tile_error,
        what="relative error of tiles",
        errors=True,
    ),
    Case(
        "normal map in grazing light: the same",
        lambda: scene(ball=None, floor=floor(normals()), lamp=low_spot()),
        depth=2,
        measure=tile_error,
        what="relative error of tiles",
        errors=True,
    ),
    Case(
        "`hide_emitters`: hidden lamps still cast their shapes on the image",
        hidden_lamp,
        parameters={"hide_emitters": True},
    ),
    Case(
        "`hide_emitters`: a sphere behind a hidden lamp; `path` shades it at a wrong place (14 % too dark)",
        behind_hidden_lamp,
        equal=lambda: behind_hidden_lamp(near_clip=3.4),
        parameters={"hide_emitters": True},
    ),
    Case(
        "area light with a (uniform) bitmap on a `cube`: one face of six emits; `path` loses light too",
        lambda: scene(lamp=cube_lamp(bitmap(np.ones((4, 4, 3))))),
        equal=lambda: scene(lamp=cube_lamp(1.0)),
    ),
    Case(
        "area light whose bitmap is moved by `to_uv`: light comes from where the bitmap was",
        lambda: scene(
            lamp=lamp(
                bitmap(
                    np.repeat([[[8.0], [8.0], [0.0], [0.0]]], 4, axis=0) * np.ones(3),
                    to_uv=transform().translate([0.5, 0, 0]),
                )
            )
        ),
    ),
    Case("`directional` in a scene that has grown since: only the old bounds are lit", moved_floor),
    Case(
        "a mirror fills the view: what mirrors and glass show takes s = 0 or s = 1",
        lambda: scene(
            back={
                "type": "rectangle",
                "bsdf": {"type": "conductor"},
                "to_world": transform().translate([0, 1, -2]).scale(2),
            },
            lamp=lamp(),
        ),
    ),
    Case(
        "alpha: counts splats instead of coverage",
        lambda: scene(sensor(film_keys={"pixel_format": "rgba"}), lamp=lamp()),
        measure=alpha,
        what="mean alpha",
    ),
    Case(
        "faint light (radiance 1e-6), closed room, depth 30: roulette looks at radiance; noise drowns all",
        lambda: closed_room(1e-6),
        depth=30,
        measure=tile_error,
        what="relative error of tiles",
        errors=True,
    ),
    Case(
        "point light before an open lens; `path` misses it as well",
        point_before_a_lens,
        depth=1,
        right=float(POINT_SEEN),
    ),
    Case(
        "a shape between pinhole and near plane hides the scene",
        lambda: scene(sensor(near_clip=1.0), lamp=lamp(), blocker=blocker()),
    ),
    Case(
        "sensor with a response function (`srf`), spectral variant: ignored",
        lambda: scene(
            sensor(srf={"type": "regular", "wavelength_min": 500, "wavelength_max": 600, "values": "1, 2"}),
            lamp=lamp({"type": "rgb", "value": 8.0}),
        ),
        variant="llvm_ad_spectral",
    ),
    Case(
        "area light on a sphere that is rotated: points turn, their normals do not",
        lambda: scene(lamp=round_lamp(turned=True)),
        equal=lambda: scene(lamp=round_lamp(turned=False)),
    ),
    Case(
        "bitmap on a `rectangle` lamp with `flip_normals`: it shines from its back; `path` is wrong too",
        lambda: scene(
            lamp=lamp(
                bitmap(np.full((4, 4, 3), 8.0)),
                flip_normals=True,
                to_world=transform().translate([0.4, 2.5, 0]).rotate([1, 0, 0], -90).scale(0.5),
            )
        ),
        equal=lambda: scene(lamp=lamp()),
    ),
    Case(
        "a scene 0.4 mm wide (scaled by 1e-4): offsets of rays swallow it; of `path` too",
        lambda: tiny(1e-4),
        equal=lambda: tiny(1.0),
    ),
    Case(
        "a sheet 0.3 mm thick with a `mask` of opacity 0.5, 3 m from the origin, before a white sky: masks "
        "are opaque; `path` skips the second face and has 0.5",
        sheet,
        right=0.25,
    ),
]


# -- running ----------------------------------------------------------------------------------


def rendered(made, kind, depth, spp, **parameters):
    """Mean image of `RENDERS` renders."""
    integrator = mi.load_dict({"type": kind, "max_depth": depth, **parameters})
    width, height = made.sensors()[0].film().crop_size()
    spp = spp * SIZE * SIZE // (width * height)
    total = 0.0
    for seed in range(RENDERS):
        total = total + np.array(integrator.render(made, spp=spp, seed=seed), np.float64)
    return total / RENDERS


def run(case: Case) -> Row:
    """Both light tracers, and the right number."""
    mi.set_variant(case.variant)
    reference = rendered((case.equal or case.scene)(), "path", case.depth, FINER * SPP, **case.parameters)
    right = case.right
    if right is None:  # of an error: 0
        right = float(case.measure(reference, reference))
    ours = rendered(case.scene(), "bdpt", case.depth, SPP, **case.parameters)
    try:
        theirs = rendered(case.scene(), "ptracer", case.depth, SPP, **case.parameters)
    except RuntimeError as error:
        if "not implemented" not in str(error).lower():
            raise
        theirs = None
    return Row(
        case,
        right,
        None if theirs is None else float(case.measure(theirs, reference)),
        float(case.measure(ours, reference)),
    )


def page(rows) -> str:
    """The table in Markdown."""

    def number(value):
        return "raises an error" if value is None else f"{value:.4g}"

    return table(
        ["what goes wrong", "number", "right", "`ptracer`", "`bdpt`"],
        [[r.case.name, r.case.what, number(r.right), number(r.theirs), number(r.ours)] for r in rows],
    )


def main(arguments=None) -> int:
    """Command line; returns the exit status."""
    parser = command_line.parser(__doc__)
    parser.add_argument("--page", type=Path, help="Markdown file whose part is replaced")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    options = parser.parse_args(arguments)
    rows = []
    for case in CASES:
        if options.only in case.name:
            rows.append(run(case))
            print(page(rows[-1:]).splitlines()[-1], flush=True)
    wrong = [f"`bdpt` is off: {r.case.name}" for r in rows if r.off(r.ours)]
    wrong += [f"`ptracer` is right: {r.case.name}" for r in rows if not r.off(r.theirs)]
    print("\n".join(wrong), end="\n" if wrong else "")
    if options.page and not wrong:
        write_text(options.page, replace_part(options.page.read_text(), "ptracer", page(rows)))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(answered(main))
