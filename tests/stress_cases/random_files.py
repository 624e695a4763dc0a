"""Scene files drawn at random, as people write them: groups, instances, textures, nested BSDFs, media.

`Generator` writes XML; what that refers to is written by `write_assets`.
"""

import random
from functools import partial
from pathlib import Path

import numpy as np

import mitsuba as mi  # isort: skip

# BSDFs that transmit, or let pass: none for a two-sided one, and none for lamps.
_TRANSMIT = (
    "dielectric",
    "thindielectric",
    "roughdielectric",
    "principledthin",
    "hair",
    "mask",
    "spec_trans",
)
_DEPTH = 3  # nested BSDFs


def el(tag: str, *inside: str, **attributes) -> str:
    """An element; of numbers four digits."""
    texts = (f' {k}="{v:.4g}"' if isinstance(v, float) else f' {k}="{v}"' for k, v in attributes.items())
    return f"<{tag}{''.join(texts)}>{''.join(inside)}</{tag}>"


def number(name: str, value: float) -> str:
    return el("float", name=name, value=float(value))


def string(name: str, value) -> str:
    return el("string", name=name, value=value)


def flag(name: str, value: bool = True) -> str:
    return el("boolean", name=name, value=str(value).lower())


class Generator:
    """Draws from ``rng``.

    ``plain``: nothing of which `path` is known to be wrong or blind: no masks, blends, nor what is beyond
    its reach (delta emitters beside delta BSDFs, or seen by a lens).
    """

    def __init__(self, rng: random.Random, folder: Path, plain: bool = False):
        self.rng, self.folder, self.plain = rng, folder, plain
        self.ids: list[str] = []
        self.has_sky = False
        self.delta = self.rng.random() < 0.5
        """Whether there are delta BSDFs; if not there may be delta emitters."""

    def colour(self, low=0.1, high=0.8) -> str:
        return ",".join(f"{self.rng.uniform(low, high):.2f}" for _ in range(3))

    def rgb(self, name, low=0.1, high=0.8) -> str:
        return el("rgb", name=name, value=self.colour(low, high))

    def paint(self, name) -> str:
        """A reflectance, sometimes black."""
        return self.rgb(name) if self.rng.random() < 0.85 else self.rgb(name, 0, 0)

    def bitmap(self, name, file, raw=True) -> str:
        inside = [string("filename", self.folder / file), *([flag("raw")] if raw else [])]
        return el("texture", *inside, type="bitmap", name=name)

    def texture(self, name) -> str:
        kind = self.rng.choice(["rgb", "rgb", "bitmap", "checkerboard"])
        if kind == "rgb":
            return self.paint(name)
        if kind == "bitmap":
            return self.bitmap(name, "rgb.png", raw=False)
        return el("texture", self.paint("color0"), self.paint("color1"), type=kind, name=name)

    # -- BSDFs --------------------------------------------------------------------------------------------

    def bsdf(self, depth=0, maps=True, **attributes) -> str:
        """A BSDF with others inside; ``maps``: with bump and normal maps."""
        kinds = ["diffuse", "diffuse", "roughconductor", "roughplastic", "principled"]
        kinds += ["roughdielectric", "principledthin", "hair"]
        kinds += ["plastic", "conductor", "dielectric", "thindielectric", "pplastic"] if self.delta else []
        if depth < _DEPTH:
            kinds += ["twosided", *(["bumpmap", "normalmap"] if maps else [])]
            kinds += [] if self.plain else ["mask", "blendbsdf"]
        kind = self.rng.choice(kinds)
        inner = partial(self.bsdf, depth + 1, maps)
        nested = {
            "twosided": lambda: [self._opaque(depth + 1, maps)],
            "mask": lambda: [self._share("opacity"), inner()],
            "blendbsdf": lambda: [self._share("weight"), inner(), inner()],
            "bumpmap": lambda: [
                self.bitmap("heights", "gray.png"),
                number("scale", self.rng.choice([0.02, 0.2])),
                inner(),
            ],
            "normalmap": lambda: [self.bitmap("normalmap", "normal.png"), inner()],
        }
        return el("bsdf", *(nested[kind]() if kind in nested else self._leaf(kind)), type=kind, **attributes)

    def _leaf(self, kind) -> list[str]:
        rng = self.rng
        if kind == "diffuse":
            return [self.texture("reflectance")]
        if kind == "principled":
            names = rng.sample(["metallic", "specular", "anisotropic", "sheen", "clearcoat", "spec_trans"], 2)
            values = [number("roughness", rng.uniform(0.2, 1)), *(number(n, rng.random()) for n in names)]
            return [self.texture("base_color"), *values]
        if kind == "principledthin":
            values = {"roughness": (0.2, 0.8), "spec_trans": (0, 0.6), "diff_trans": (0, 2)}
            return [self.texture("base_color"), *(number(n, rng.uniform(*r)) for n, r in values.items())]
        if not kind.startswith("rough"):
            return []
        if kind == "roughconductor" and rng.random() < 0.3:
            return [number("alpha_u", 0.1), number("alpha_v", 0.4)]
        alpha = number("alpha", rng.choice([0.1, 0.2, 0.5]))
        return [alpha, string("distribution", rng.choice(["beckmann", "ggx"]))]

    def _opaque(self, depth=0, maps=True) -> str:
        """A BSDF that a ``twosided`` takes."""
        found = self.bsdf(depth, maps)
        while any(f'="{word}' in found for word in (*_TRANSMIT, "twosided")):
            found = self.bsdf(depth, maps)
        return found

    def _share(self, name) -> str:
        if self.rng.random() < 0.5:
            return number(name, self.rng.uniform(0.2, 0.8))
        return self.bitmap(name, "gray.png")

    def material(self) -> str:
        """A BSDF in place, or one that has an id."""
        if self.ids and self.rng.random() < 0.6:
            return el("ref", id=self.rng.choice(self.ids))
        return self.bsdf()

    # -- shapes -------------------------------------------------------------------------------------------

    def to_world(self, scale, spread, low, high, stretched=False) -> str:
        rng = self.rng
        axis = np.array([rng.gauss(0, 1) for _ in "xyz"])
        turn = {k: f"{v:.8f}" for k, v in zip("xyz", axis / np.linalg.norm(axis), strict=True)}
        sizes = {k: scale * (rng.uniform(0.6, 1.5) if stretched else 1.0) for k in "xyz"}
        steps = el("scale", **sizes), el("rotate", angle=rng.uniform(0, 360), **turn)
        x, y, z = rng.uniform(-spread, spread), rng.uniform(low, high), rng.uniform(-spread, spread)
        return el("transform", *steps, el("translate", x=x, y=y, z=z), name="to_world")

    def shape(self, kinds, size, surface, spread=1.3, heights=(0.5, 1.6)) -> str:
        """A shape of one of the ``kinds`` with this ``surface`` (XML), about as large as ``size``."""
        rng = self.rng
        kind, (low, high) = rng.choice(kinds), heights
        flipped = [flag("flip_normals")] if rng.random() < 0.15 and "emitter" not in surface else []
        if kind == "ball":  # a sphere by its centre, as in old files
            place = {"x": rng.uniform(-spread, spread), "y": rng.uniform(low, high), "z": rng.uniform(-1, 1)}
            inside = [el("point", name="center", **place), number("radius", size)]
            return el("shape", *inside, *flipped, surface, type="sphere")
        stretched = kind not in ("sphere", "cylinder") and rng.random() < 0.3
        inside = [self.to_world(size, spread, low, high, stretched), *flipped, surface]
        if kind == "ply":
            name = rng.choice(["torus.ply", "torus_normals.ply", "torus_uv.ply"])
            inside.insert(0, string("filename", self.folder / name))
        return el("shape", *inside, type=kind)

    def group(self) -> str:
        """A group of shapes, mostly without ids, and its instances."""
        rng = self.rng
        members = [
            self.shape(SOLIDS, 0.35, self.material(), 0.3, (-0.3, 0.3)) for _ in range(rng.randint(1, 3))
        ]
        found = el("shape", *members, type="shapegroup", id="group")
        for _ in range(rng.randint(1, 3)):
            place = self.to_world(rng.uniform(0.6, 1.2), 1.2, 0.5, 1.5, rng.random() < 0.3)
            found += el("shape", el("ref", id="group"), place, type="instance")
        return found

    # -- lamps --------------------------------------------------------------------------------------------

    def lamp(self) -> str:
        """An emitter, or a shape that is one."""
        kinds = ["area", "area", "area", *([] if self.has_sky else ["constant", "envmap"])]
        kinds += [] if self.delta else ["point", "spot", "projector", "directional"]
        kind = self.rng.choice(kinds)
        self.has_sky |= kind in ("constant", "envmap")
        return self.shining() if kind == "area" else self.emitter(kind)

    def shining(self) -> str:
        """A shape that is a lamp, sometimes textured."""
        rng = self.rng
        if rng.random() < 1 / 3:  # not on cubes and turned spheres, where `path` is wrong
            emitter = el("emitter", self.bitmap("radiance", "sky.exr", raw=False), type="area")
            return self.shape(["ball", "rectangle", "disk"], 0.4, emitter, 1.2, (2.2, 3.2))
        emitter = el("emitter", self.rgb("radiance", 1, 6), type="area")
        surface = self._opaque() if rng.random() < 0.5 else ""
        # Convex ones: what other lamps light of themselves `path` weighs otherwise.
        kinds = ["sphere", "cube", "rectangle", "disk", "cylinder", "ball"]
        return self.shape(kinds, rng.uniform(0.2, 0.6), emitter + surface, 1.2, (2.2, 3.2))

    def emitter(self, kind) -> str:
        rng = self.rng
        x, z = rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7)
        origin = f"{rng.uniform(-1.5, 1.5):.2f},3,{rng.uniform(-1.5, 2):.2f}"
        look = el("lookat", origin=origin, target=f"{rng.uniform(-0.5, 0.5):.2f},0.3,0", up="0,0,1")
        turn = el("rotate", y="1", angle=rng.uniform(0, 360))
        down, turn = (el("transform", step, name="to_world") for step in (look, turn))
        slide = self.bitmap("irradiance", "rgb.png", raw=False)
        inside = {
            "constant": [self.rgb("radiance")],
            "envmap": [string("filename", self.folder / "sky.exr"), turn],
            "point": [el("point", name="position", x=x, y=2.8, z=z), self.rgb("intensity", 1, 6)],
            "spot": [self.rgb("intensity", 3, 9), number("cutoff_angle", rng.choice([20, 45])), down],
            "projector": [slide, number("fov", 40), number("scale", 20), down],
            "directional": [el("vector", name="direction", x=x, y=-1.0, z=z), self.rgb("irradiance", 1, 4)],
        }
        return el("emitter", *inside[kind], type=kind)

    # -- media --------------------------------------------------------------------------------------------

    def medium(self) -> str:
        """A medium inside of a shape, homogeneous or a grid."""
        rng = self.rng
        phase = rng.choice(["isotropic", "hg", "rayleigh"])
        g = [number("g", rng.uniform(-0.6, 0.8))] if phase == "hg" else []
        inside = [
            el("phase", *g, type=phase),
            self.rgb("albedo", 0.3, 0.95),
            number("scale", rng.uniform(0.5, 3)),
        ]
        if rng.random() < 0.6:
            gray = rng.random() < 0.4
            thickness = number("sigma_t", 1) if gray else self.rgb("sigma_t", 0.3, 1)
            return el("medium", thickness, *inside, type="homogeneous", name="interior")
        box = el("translate", x=-0.5, y=-0.5, z=-0.5), el("scale", value="3"), el("translate", y="1")
        box = el("transform", *box, name="to_world")
        volume = string("filename", self.folder / "grid.vol"), box
        volume = el("volume", *volume, type="gridvolume", name="sigma_t")
        return el("medium", volume, *inside, type="heterogeneous", name="interior")

    def body(self, x: float) -> str:
        """A ball or a cube about ``x`` filled with a medium, which meets no other one."""
        boundary = self.rng.choice(
            ["null", "null", "roughdielectric", *(["dielectric"] if self.delta else [])]
        )
        place = el("transform", el("scale", value="0.5"), el("translate", x=x, y=1.2, z=0.3), name="to_world")
        inside = place, el("bsdf", type=boundary), self.medium()
        return el("shape", *inside, type=self.rng.choice(["sphere", "cube"]))

    # -- scenes -------------------------------------------------------------------------------------------

    def sensor(self) -> str:
        lens = self.rng.random() < 0.3 and (self.delta or not self.plain)
        inside = [number("aperture_radius", 0.1), number("focus_distance", 5)] if lens else []
        look = el("lookat", origin="0.3,2.2,5", target="0,0.9,0", up="0,1,0")
        film = [el("integer", name=name, value=24) for name in ("width", "height")]
        film += [el("rfilter", type=self.rng.choice(["box", "gaussian"]))]
        inside += [
            number("fov", 42),
            el("transform", look, name="to_world"),
            el("film", *film, type="hdrfilm"),
        ]
        return el("sensor", *inside, type="thinlens" if lens else "perspective")

    def scene(self, media: bool = False) -> str:
        """A scene file; with ``media`` two bodies stand in front, and no other body is entered."""
        rng, found = self.rng, ""
        for i in range(rng.randint(0, 3)):
            found += self.bsdf(id=f"material{i}")
            self.ids.append(f"material{i}")
        found += self.sensor()
        walls = [el("rotate", x="1", angle="-90") + el("scale", value="3")]
        walls += [el("scale", value="3") + el("translate", z="-2.2")] if rng.random() < 0.6 else []
        for place in walls:
            found += el("shape", el("transform", place, name="to_world"), self.material(), type="rectangle")
        if media:
            found += self.body(-0.7) + self.body(0.7)
        for _ in range(rng.randint(0, 1) if media else rng.randint(1, 4)):
            heights = (2.2, 2.8) if media else (0.5, 1.6)
            found += self.shape(SOLIDS, rng.uniform(0.25, 0.6), self.material(), 1.3, heights)
        if rng.random() < 0.4 and not media:
            found += self.group()
        lamps = [self.lamp() for _ in range(rng.randint(1, 3))]
        return el("scene", found, *lamps, version="3.0.0")


SOLIDS = ["sphere", "cube", "rectangle", "disk", "cylinder", "ply", "ball"]


def _torus():
    """Points, their normals and coordinates (96, 2 or 3), and triangles of a coarse torus."""
    a, b = 12, 8
    t, p = (x.ravel() for x in np.meshgrid(np.arange(a) / a, np.arange(b) / b, indexing="ij"))
    around, across = 2 * np.pi * t, 2 * np.pi * p
    normals = np.stack([np.cos(across) * np.cos(around), np.sin(across), np.cos(across) * np.sin(around)], -1)
    middle = np.stack([np.cos(around), np.zeros_like(t), np.sin(around)], -1)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(a), np.arange(b), indexing="ij"))
    corner = lambda i, j: (i % a) * b + j % b  # noqa: E731
    lower = np.stack([corner(i, j), corner(i, j + 1), corner(i + 1, j)], -1)
    upper = np.stack([corner(i + 1, j), corner(i, j + 1), corner(i + 1, j + 1)], -1)
    return 0.6 * middle + 0.25 * normals, normals, np.stack([t, p], -1), np.concatenate([lower, upper])


def write_assets(folder: Path) -> None:
    """Write the textures, meshes and the grid that `Generator` refers to."""
    rng = np.random.default_rng(0)
    mi.Bitmap((rng.random((16, 16, 3)) * 255).astype(np.uint8)).write(str(folder / "rgb.png"))
    mi.Bitmap((rng.random((8, 8, 1)) * 255).astype(np.uint8)).write(str(folder / "gray.png"))
    n = rng.normal(0, 0.25, (16, 16, 3))
    n[..., 2] = 1
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    mi.Bitmap(((n * 0.5 + 0.5) * 255).astype(np.uint8)).write(str(folder / "normal.png"))
    sky = rng.random((8, 16, 3)).astype(np.float32) * 0.3
    sky[2, 3] = 20
    mi.Bitmap(sky).write(str(folder / "sky.exr"))
    mi.VolumeGrid(rng.random((6, 6, 6, 1)).astype(np.float32)).write(str(folder / "grid.vol"))
    points, normals, coordinates, triangles = _torus()
    for name, has_normals, has_uv in (("", False, False), ("_normals", True, True), ("_uv", False, True)):
        mesh = mi.Mesh(
            "torus", len(points), len(triangles), has_vertex_normals=has_normals, has_vertex_texcoords=has_uv
        )
        values = mi.traverse(mesh)
        values["vertex_positions"] = points.astype(np.float32).ravel()
        values["faces"] = triangles.astype(np.uint32).ravel()
        if has_normals:
            values["vertex_normals"] = normals.astype(np.float32).ravel()
        if has_uv:
            values["vertex_texcoords"] = coordinates.astype(np.float32).ravel()
        values.update()
        mesh.write_ply(str(folder / f"torus{name}.ply"))
