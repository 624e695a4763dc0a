"""Scenes drawn at random, as people write them: groups, instances, textures, nested BSDFs, media."""

import random
from functools import cache

import meshes
import mitsuba as mi
import numpy as np
from scene_parts import T

# What transmits, or lets pass: nothing for a two-sided BSDF, nor for lamps.
TRANSMIT = "dielectric", "thindielectric", "roughdielectric", "principledthin", "hair", "mask", "spec_trans"
SOLIDS = "sphere", "cube", "rectangle", "disk", "cylinder", "ply", "ball"
DEPTH = 3  # nested BSDFs


@cache
def pixels() -> dict:
    """Data of bitmaps by name."""
    rng = np.random.default_rng(0)
    normal = rng.normal(0, 0.25, (16, 16, 3))
    normal[..., 2] = 1
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    sky = rng.random((8, 16, 3)).astype(np.float32) * 0.3
    sky[2, 3] = 20
    small = {"rgb": rng.random((16, 16, 3)), "gray": rng.random((8, 8, 1)), "normal": normal * 0.5 + 0.5}
    return {name: (data * 255).astype(np.uint8) for name, data in small.items()} | {"sky": sky}


def bitmap(name, raw=True, kind="bitmap", **more):
    raw = {"raw": raw} if kind == "bitmap" else {}
    return {"type": kind, "bitmap": mi.Bitmap(pixels()[name])} | raw | more


@cache
def torus(has_normals, has_coordinates):
    """A coarse torus of triangles."""
    a, b = 12, 8
    i, j = (x.ravel() for x in np.meshgrid(np.arange(a), np.arange(b), indexing="ij"))
    around, across = 2 * np.pi * i / a, 2 * np.pi * j / b
    normals = np.stack([np.cos(across) * np.cos(around), np.sin(across), np.cos(across) * np.sin(around)], -1)
    middle = np.stack([np.cos(around), 0 * around, np.sin(around)], -1)
    here, up = i * b + j, i * b + (j + 1) % b
    beyond, across = (here + b) % (a * b), (up + b) % (a * b)
    faces = np.concatenate([np.stack([here, up, beyond], -1), np.stack([beyond, up, across], -1)])
    coordinates = np.stack([i / a, j / b], -1) if has_coordinates else None
    return meshes.as_ply(0.6 * middle + 0.25 * normals, faces, normals if has_normals else None, coordinates)


class Generator:
    """Draws from ``rng``.

    ``plain``: nothing of which `path` is known to be wrong or blind: no masks, blends, nor what is beyond
    its reach (delta emitters beside delta BSDFs, or seen by a lens).
    """

    def __init__(self, rng: random.Random, plain: bool = False):
        self.rng, self.plain = rng, plain
        self.shared: list[mi.BSDF] = []
        self.has_sky = False
        self.delta = self.rng.random() < 0.5
        """Whether there are delta BSDFs; if not there may be delta emitters."""

    def rgb(self, low=0.1, high=0.8):
        return {"type": "rgb", "value": [self.rng.uniform(low, high) for _ in range(3)]}

    def paint(self):
        """A reflectance, sometimes black."""
        return self.rgb() if self.rng.random() < 0.85 else self.rgb(0, 0)

    def texture(self):
        kind = self.rng.choice(["rgb", "rgb", "bitmap", "checkerboard"])
        if kind == "bitmap":
            return bitmap("rgb", raw=False)
        return (
            self.paint() if kind == "rgb" else {"type": kind, "color0": self.paint(), "color1": self.paint()}
        )

    # -- BSDFs --------------------------------------------------------------------------------------------

    def bsdf(self, depth=0, maps=True):
        """A BSDF with others inside; ``maps``: with bump and normal maps."""
        kinds = ["diffuse", "diffuse", "roughconductor", "roughplastic", "principled"]
        kinds += ["roughdielectric", "principledthin", "hair"]
        kinds += ["plastic", "conductor", "dielectric", "thindielectric", "pplastic"] if self.delta else []
        if depth < DEPTH:
            kinds += ["twosided", *(["bumpmap", "normalmap"] if maps else [])]
            kinds += [] if self.plain else ["mask", "blendbsdf"]
        kind, inner = self.rng.choice(kinds), lambda: self.bsdf(depth + 1, maps)
        parts = {
            "twosided": lambda: {"one": self.opaque(depth + 1, maps)},
            "mask": lambda: {"opacity": self.share(), "one": inner()},
            "blendbsdf": lambda: {"weight": self.share(), "one": inner(), "two": inner()},
            "bumpmap": lambda: {
                "heights": bitmap("gray"),
                "scale": self.rng.choice([0.02, 0.2]),
                "one": inner(),
            },
            "normalmap": lambda: {"normalmap": bitmap("normal"), "one": inner()},
        }
        return {"type": kind} | (parts[kind]() if kind in parts else self.leaf(kind))

    def leaf(self, kind):
        rng = self.rng
        if kind == "diffuse":
            return {"reflectance": self.texture()}
        if kind == "principled":
            names = rng.sample(["metallic", "specular", "anisotropic", "sheen", "clearcoat", "spec_trans"], 2)
            values = {"roughness": rng.uniform(0.2, 1)} | {name: rng.random() for name in names}
            return values | {"base_color": self.texture()}
        if kind == "principledthin":
            bounds = {"roughness": (0.2, 0.8), "spec_trans": (0, 0.6), "diff_trans": (0, 2)}
            return {"base_color": self.texture()} | {n: rng.uniform(*b) for n, b in bounds.items()}
        if not kind.startswith("rough"):
            return {}
        if kind == "roughconductor" and rng.random() < 0.3:
            return {"alpha_u": 0.1, "alpha_v": 0.4}
        return {"alpha": rng.choice([0.1, 0.2, 0.5]), "distribution": rng.choice(["beckmann", "ggx"])}

    def opaque(self, depth=0, maps=True):
        """A BSDF that a ``twosided`` takes."""
        found = self.bsdf(depth, maps)
        while any(f"'{word}" in str(found) for word in (*TRANSMIT, "twosided")):
            found = self.bsdf(depth, maps)
        return found

    def share(self):
        return self.rng.uniform(0.2, 0.8) if self.rng.random() < 0.5 else bitmap("gray")

    def material(self):
        """A BSDF of its own, or one that others have too."""
        shared = self.shared and self.rng.random() < 0.6
        return {"bsdf": self.rng.choice(self.shared) if shared else self.bsdf()}

    # -- shapes -------------------------------------------------------------------------------------------

    def to_world(self, scale, spread, low, high, stretched=False):
        rng = self.rng
        axis = np.array([rng.gauss(0, 1) for _ in "xyz"])
        sizes = [scale * (rng.uniform(0.6, 1.5) if stretched else 1.0) for _ in "xyz"]
        angle = rng.uniform(0, 360)
        place = [rng.uniform(-spread, spread), rng.uniform(low, high), rng.uniform(-spread, spread)]
        return T().translate(place).rotate(list(axis / np.linalg.norm(axis)), angle).scale(sizes)

    def shape(self, kinds, size, surface, spread=1.3, heights=(0.5, 1.6)):
        """A shape of one of the ``kinds`` with this ``surface`` (its parts), about as large as ``size``."""
        rng = self.rng
        kind, (low, high) = rng.choice(kinds), heights
        flipped = rng.random() < 0.15 and "emitter" not in surface
        surface = surface | ({"flip_normals": True} if flipped else {})
        if kind == "ball":  # a sphere by its centre, as in old files
            place = [rng.uniform(-spread, spread), rng.uniform(low, high), rng.uniform(-1, 1)]
            return {"type": "sphere", "center": place, "radius": size} | surface
        stretched = kind not in ("sphere", "cylinder") and rng.random() < 0.3
        surface["to_world"] = self.to_world(size, spread, low, high, stretched)
        if kind == "ply":
            return torus(*rng.choice([(False, False), (True, True), (False, True)])) | surface
        return {"type": kind} | surface

    def group(self):
        """A group of shapes and its instances."""
        rng = self.rng
        members = [
            self.shape(SOLIDS, 0.35, self.material(), 0.3, (-0.3, 0.3)) for _ in range(rng.randint(1, 3))
        ]
        parts = [{"type": "shapegroup"} | {f"member{i}": shape for i, shape in enumerate(members)}]
        for _ in range(rng.randint(1, 3)):
            place = self.to_world(rng.uniform(0.6, 1.2), 1.2, 0.5, 1.5, rng.random() < 0.3)
            parts.append({"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}})
        return {"group" + "0" * i: part for i, part in enumerate(parts)}

    # -- lamps --------------------------------------------------------------------------------------------

    def lamp(self):
        """An emitter, or a shape that is one."""
        kinds = ["area", "area", "area", *([] if self.has_sky else ["constant", "envmap"])]
        kinds += [] if self.delta else ["point", "spot", "projector", "directional"]
        kind = self.rng.choice(kinds)
        self.has_sky |= kind in ("constant", "envmap")
        return self.shining() if kind == "area" else self.emitter(kind)

    def shining(self):
        """A shape that is a lamp, sometimes textured."""
        rng = self.rng
        if rng.random() < 1 / 3:  # not on cubes and turned spheres, where `path` is wrong
            surface = {"emitter": {"type": "area", "radiance": bitmap("sky", raw=False)}}
            return self.shape(["ball", "rectangle", "disk"], 0.4, surface, 1.2, (2.2, 3.2))
        surface = {"emitter": {"type": "area", "radiance": self.rgb(1, 6)}}
        surface |= {"bsdf": self.opaque()} if rng.random() < 0.5 else {}
        # Convex ones: what other lamps light of themselves `path` weighs otherwise.
        kinds = ["sphere", "cube", "rectangle", "disk", "cylinder", "ball"]
        return self.shape(kinds, rng.uniform(0.2, 0.6), surface, 1.2, (2.2, 3.2))

    def emitter(self, kind):
        rng = self.rng
        x, z = rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7)
        origin = [rng.uniform(-1.5, 1.5), 3, rng.uniform(-1.5, 2)]
        down = {"to_world": T().look_at(origin, [rng.uniform(-0.5, 0.5), 0.3, 0], [0, 0, 1])}
        turn = {"to_world": T().rotate([0, 1, 0], rng.uniform(0, 360))}
        made = {
            "constant": {"radiance": self.rgb()},
            "envmap": bitmap("sky", kind="envmap") | turn,
            "point": {"position": [x, 2.8, z], "intensity": self.rgb(1, 6)},
            "spot": {"intensity": self.rgb(3, 9), "cutoff_angle": rng.choice([20, 45])} | down,
            "projector": {"irradiance": bitmap("rgb", raw=False), "fov": 40, "scale": 20} | down,
            "directional": {"direction": [x, -1, z], "irradiance": self.rgb(1, 4)},
        }
        return {"type": kind} | made[kind]

    # -- media --------------------------------------------------------------------------------------------

    def medium(self):
        """A medium inside of a shape, homogeneous or a grid."""
        rng = self.rng
        phase = {"type": rng.choice(["isotropic", "hg", "rayleigh"])}
        phase |= {"g": rng.uniform(-0.6, 0.8)} if phase["type"] == "hg" else {}
        inside = {"phase": phase, "albedo": self.rgb(0.3, 0.95), "scale": rng.uniform(0.5, 3)}
        if rng.random() < 0.6:
            thickness = 1.0 if rng.random() < 0.4 else self.rgb(0.3, 1)
            return {"type": "homogeneous", "sigma_t": thickness} | inside
        grid = mi.VolumeGrid(np.random.default_rng(0).random((6, 6, 6, 1)).astype(np.float32))
        box = T().translate([0, 1, 0]).scale(3).translate([-0.5, -0.5, -0.5])
        volume = {"type": "gridvolume", "grid": grid, "to_world": box}
        return {"type": "heterogeneous", "sigma_t": volume} | inside

    def body(self, x: float):
        """A ball or a cube about ``x`` filled with a medium, which meets no other one."""
        boundaries = ["null", "null", "roughdielectric", *(["dielectric"] if self.delta else [])]
        inside = {"bsdf": {"type": self.rng.choice(boundaries)}, "interior": self.medium()}
        inside["to_world"] = T().translate([x, 1.2, 0.3]).scale(0.5)
        return {"type": self.rng.choice(["sphere", "cube"])} | inside

    # -- scenes -------------------------------------------------------------------------------------------

    def sensor(self):
        lens = self.rng.random() < 0.3 and (self.delta or not self.plain)
        more = {"aperture_radius": 0.1, "focus_distance": 5.0} if lens else {}
        film = {"type": "hdrfilm", "width": 24, "height": 24}
        film["rfilter"] = {"type": self.rng.choice(["box", "gaussian"])}
        more |= {"fov": 42, "to_world": T().look_at([0.3, 2.2, 5], [0, 0.9, 0], [0, 1, 0]), "film": film}
        return {"type": "thinlens" if lens else "perspective"} | more

    def scene(self, media: bool = False):
        """A scene's dictionary; with ``media`` two bodies stand in front, and no other body is entered."""
        rng = self.rng
        self.shared = [mi.load_dict(self.bsdf()) for _ in range(rng.randint(0, 3))]
        found = {"type": "scene", "sensor": self.sensor()}
        walls = [T().scale(3).rotate([1, 0, 0], -90)]
        walls += [T().translate([0, 0, -2.2]).scale(3)] if rng.random() < 0.6 else []
        parts = [{"type": "rectangle", "to_world": place} | self.material() for place in walls]
        parts += [self.body(-0.7), self.body(0.7)] if media else []
        for _ in range(rng.randint(0, 1) if media else rng.randint(1, 4)):
            heights = (2.2, 2.8) if media else (0.5, 1.6)
            parts.append(self.shape(SOLIDS, rng.uniform(0.25, 0.6), self.material(), 1.3, heights))
        found |= self.group() if rng.random() < 0.4 and not media else {}
        parts += [self.lamp() for _ in range(rng.randint(1, 3))]
        return found | {f"part{i}": part for i, part in enumerate(parts)}
