"""Scenes of SDS paths: a floor under a plate of glass, lamp and camera above."""

import json

import internals
import mitsuba as mi
import numpy as np

import scenes
from scenes import area, both_sides, camera, matte, square, transform

LAMP, CAMERA, FOV, SIZE = (0.5, 0.0, 4.5), (0.0, 0.5, 3.0), 60, 16

# Of a lamp that the plate does not mirror into the camera.
ASIDE = [5.0, 0.0, 4.5]

IOR, THICKNESS, ALBEDO, INTENSITY = 1.5, 0.2, 0.5, 10.0


def point():
    return {"type": "point", "position": list(LAMP), "intensity": INTENSITY}


def sun():
    return {"type": "directional", "direction": [0.3, 0.1, -1.0], "irradiance": 5.0}


def ball(radius=0.5):
    return scenes.ball(matte(0.0), radius, LAMP, emitter=area(10.0))


def spark():
    """A lamp with the flux of `ball`, so small that paths from it through the plate are merged."""
    return ball(0.05) | {"emitter": area(1000.0)}


def glass():
    return {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0}


def under_glass(light, floor=None, plate=None, kind="perspective", **more):
    """The scene; ``more`` of its entries."""
    lens = {"aperture_radius": 0.3, "focus_distance": 3.0} if kind == "thinlens" else {}
    eye = camera(kind, origin=CAMERA, target=(0, 0, 0), fov=FOV, size=SIZE, **lens)
    to_world = transform().translate([0, 0, 0.5]).scale([4, 4, THICKNESS / 2])
    return {
        "type": "scene",
        "sensor": eye,
        "floor": square(size=4, bsdf=floor),
        "plate": {"type": "cube", "to_world": to_world, "bsdf": plate or glass()},
        "light": light,
        **more,
    }


WATER = 1.33


def pool(medium, light, bed, **more):
    """Water of depth 1 between black walls, which is a ``medium``; its floor is a ``bed``.

    The camera sees no mirrored lamp.
    """
    clear, within = {"type": "dielectric", "int_ior": WATER, "ext_ior": 1.0}, {"type": "ref", "id": "water"}
    wall = {"type": "cylinder", "p0": [0, 0, -1], "p1": [0, 0, 0], "radius": 1.5, "bsdf": both_sides(0.0)}
    return {
        "type": "scene",
        "medium": medium | {"id": "water"},
        "sensor": camera(origin=(-2.2, -2, 2.5), target=(0, 0, -0.3), fov=40, size=SIZE),
        "surface": {"type": "disk", "to_world": transform().scale(1.5), "bsdf": clear, "interior": within},
        "wall": wall | {"interior": within},
        "floor": {"type": "disk", "to_world": transform().translate([0, 0, -1]).scale(1.5), "bsdf": bed},
        "light": light | ({"center": [-2.2, 2.0, 2.5]} if light["type"] == "sphere" else {}),
        **more,
    }


def rendered(method, scene, spp, seeds, first=0, merges=True):
    """(seeds, height, width, channels); unless not ``merges``, ``merging=true`` merges vertices."""
    found, merged = [], 0
    for seed in range(first, first + seeds):
        found.append(np.array(mi.render(scene, integrator=method, spp=spp, seed=seed), dtype=np.float64))
        merged += method.statistics.get("merging", {}).get("merges", 0)
    assert merged or not merges or method.settings.merging is not True, "nothing is merged"
    return np.array(found)


def images(scene, spp, seeds=8, first=0, merges=True, **parameters):
    """(seeds, height, width) of the first colour; see `rendered`."""
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    method = internals.bdpt(**{"max_depth": 6, "rr_depth": 100, **parameters})
    return rendered(method, scene, spp, seeds, first, merges)[..., 0]


def guided(samples):
    """The decision for all strategies, with so many guided samples."""
    way = {"light_paths": 1.0, "connections": "one", "guided": samples}
    more = {"coefficients": {"t<=1": 1.0, "s=1": 1.0}, "cost": 1.0, "variance": 1.0, "mean": 0.0}
    return json.dumps([way | more])


def bumpy(bsdf):
    rng = np.random.default_rng(2)
    heights = mi.Bitmap(rng.random((16, 16, 1), dtype=np.float32) * 0.02)
    texture = {"type": "bitmap", "bitmap": heights, "raw": True}
    return {"type": "bumpmap", "arbitrary": texture, "bsdf": bsdf}


def mirror(**bsdf):
    """Beside the floor, so that the camera sees it there too."""
    return square((-1.5, 0, 1), ([0, 1, 0], 90), bsdf={"type": "conductor", **bsdf})


CASES = {
    "diffuse": {},
    "plastic": {"floor": {"type": "plastic"}},
    "rough metal": {"floor": {"type": "roughconductor", "alpha": 0.3}},
    "rough glass above": {"plate": {"type": "thindielectric"}},
    "bumpy glass": {"plate": bumpy(glass())},
    "bumpy floor": {"floor": bumpy(matte())},
    "masked floor": {"floor": {"type": "mask", "opacity": 0.6, "bsdf": {"type": "diffuse"}}},
    "mirror": {"mirror": mirror()},
    "lens": {"kind": "thinlens"},
}


def strategy_images(scene, spp, seeds, first=0, **more):
    """Images and layers of the first colour by name, each (seeds, height, width)."""
    parameters = {"max_depth": 6, "rr_depth": 100, "merging": True, "merging_radius": 0.25}
    method = internals.bdpt(**parameters | {"layers": "strategies"} | more)
    found = rendered(method, scene, spp, seeds, first)
    names = method.aov_names()
    assert found.shape[-1] == 3 + len(names)
    return found[..., 0], {n[:-2]: found[..., 3 + i] for i, n in enumerate(names) if n.endswith(".R")}


def rough(alpha):
    return {"type": "roughdielectric", "alpha": alpha, "int_ior": IOR, "ext_ior": 1.0}


def principled(roughness):
    found = {"type": "principled", "spec_trans": 1.0, "roughness": roughness, "eta": IOR}
    return found | {"base_color": {"type": "rgb", "value": 1.0}}


def ramp():
    """Glass whose alpha grows along the plate from .002 to .4, by a factor in each texel."""
    row = np.geomspace(0.002, 0.4, 16, dtype=np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.tile(row, (2, 1))[..., None]), "raw": True}
    return rough(texture)


def steel(alpha):
    """A mirror of rough metal."""
    return mirror(type="roughconductor", alpha=alpha)


# Near-specular lobes, between what is a delta lobe and what is none.
NEAR_SPECULAR = {
    "alpha .005": {"plate": rough(0.005)},
    "alpha .03": {"plate": rough(0.03)},
    "alpha .15": {"plate": rough(0.15)},
    "ramp": {"plate": ramp()},
    "principled": {"plate": principled(0.1)},
    "blend": {"plate": {"type": "blendbsdf", "weight": 0.4, "a": rough(0.01), "b": rough(0.3)}},
    "bumpy": {"plate": bumpy(rough(0.02))},
    "steel": {"plate": glass(), "mirror": steel(0.02)},
    "coated floor": {"plate": rough(0.02), "floor": {"type": "roughplastic", "alpha": 0.02}},
    "lens": {"plate": rough(0.02), "kind": "thinlens"},
}
