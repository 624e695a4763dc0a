"""Polarized light: optics that is known, Mitsuba's ``stokes`` around ``path``, each strategy by itself.

Statistics as in `test_strategies`; scenes are made inside of tests, since objects of one variant are of no
use in another.
"""

from dataclasses import replace

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import variants
import welch as st
from mitsuba_bdpt.geometry import polarization
from mitsuba_bdpt.image import sink
from mitsuba_bdpt.image.colour import STOKES_NAMES
from mitsuba_bdpt.image.layers import strategies
from mitsuba_bdpt.run import rendering

import scenes
from scenes import area, camera, load, matte, renders, square, transform

RUNS, TILES = 16, 4
METAL = {"eta": 0.5, "k": 2.0}
MIRROR = {"type": "conductor", **METAL}
ROUGH = {"type": "roughconductor", "alpha": 0.3, **METAL}
PLASTIC = {"type": "pplastic", "alpha": 0.3, "diffuse_reflectance": 0.5}
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
FIRST = slice(0, None, 3)  # of the layers of a monochromatic variant, where R, G and B are the same


@pytest.fixture(autouse=True)
def _polarized():
    mi.set_variant(variants.of("mono_polarized"))


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "layers": "stokes", **parameters})


def layers(scene, integrator, spp, seed=0):
    """S0 to S3 of each pixel, (height, width, 4)."""
    image = np.array(integrator.render(scene, spp=spp, seed=seed), dtype=np.float64)
    return image[..., -12:][..., FIRST]


# -- optics that is known ---------------------------------------------------------------------


def polarizer(theta):
    return {"type": "polarizer", "theta": float(theta)}


def retarder(theta, delta):
    return {"type": "retarder", "theta": float(theta), "delta": float(delta)}


def filters(*bsdfs):
    """Squares across the z axis, the first one first met by light that travels along it towards +z."""
    return {f"filter {i}": square((0, 0, 0.1 * i), bsdf=bsdf) for i, bsdf in enumerate(bsdfs)}


def seen_through(*bsdfs):
    """S0 to S3 of a lamp of radiance 1 that a camera sees through filters: the camera's subpaths."""
    eye = camera(origin=(0, 0, 3), target=(0, 0, 0), fov=2, size=4)
    scene = load(sensor=eye, lamp=square((0, 0, -1), emitter=area(1.0)), **filters(*bsdfs))
    return layers(scene, bdpt(max_depth=8, skip="none"), 4).mean((0, 1))


def thrown_through(*bsdfs):
    """The share of a spot's light that filters let pass to a matte wall: the light's subpaths."""
    along = transform().look_at([0, 0, -1], [0, 0, 1], [0, 1, 0])
    scene = {
        "spot": {"type": "spot", "to_world": along, "cutoff_angle": 4.0, "intensity": 1.0},
        "wall": square((0, 0, 1), ([0, 1, 0], 180), bsdf={"type": "twosided", "nested": matte(0.5)}),
        "sensor": camera(origin=(1.5, 0, 0.4), target=(0, 0, 1), fov=2, size=4),
    }
    method = bdpt(max_depth=8, skip="none")
    with_, without = (
        layers(load(**scene, **more), method, 4096)[..., 0].mean() for more in (filters(*bsdfs), {})
    )
    return with_ / without


@pytest.mark.parametrize(
    "bsdfs, expected",
    [
        *(((polarizer(20), polarizer(20 + a)), np.cos(np.radians(a)) ** 2 / 2) for a in (0, 30, 90)),
        *(
            ((polarizer(0), retarder(45, delta), polarizer(90)), np.sin(np.radians(delta) / 2) ** 2 / 2)
            for delta in (90, 180, 250)
        ),
    ],
    ids=[f"polarizer {a}" for a in (0, 30, 90)] + [f"retarder {delta}" for delta in (90, 180, 250)],
)
def test_light_through_filters(bsdfs, expected):
    """Malus' law: half of cos^2 of the angle passes two polarizers; sin^2(delta / 2) of what the first of two
    crossed ones passes if a retarder is between them, at 45 degrees. From either side, and polarized. To 2e-3
    on the camera's side, where directions are within a degree of the axis; the light's side has noise of 1 %
    and directions within four."""
    seen = seen_through(*bsdfs)
    assert seen[0] == pytest.approx(expected, abs=2e-3)
    assert np.hypot(seen[1], seen[2]) == pytest.approx(expected, abs=2e-3) and abs(seen[3]) < 1e-4
    assert thrown_through(*bsdfs) == pytest.approx(expected, abs=0.012)


@pytest.mark.parametrize("left", [False, True])
def test_circular_polarizer(left):
    """S3 = S0 of the right-handed one, -S0 of the other."""
    s0, s1, s2, s3 = seen_through({"type": "circular", "left_handed": left})
    assert s0 == pytest.approx(0.5, abs=1e-4) and max(abs(s1), abs(s2)) < 1e-3
    assert s3 == pytest.approx(-0.5 if left else 0.5, abs=1e-3)


def mirrored(bsdf, degrees, *more):
    """S0 to S3 of a lamp of radiance 1 seen mirrored in a horizontal surface, ``degrees`` from its normal;
    from the inside if there are filters on the way."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees)) * (-1 if more else 1)
    facing = transform().look_at([-5 * sine, 5 * cosine, 0], [0, 0, 0], [0, 0, 1]).scale(2.0)
    across = transform().look_at([-2 * sine, 2 * cosine, 0], [0, 0, 0], [0, 1, 0])
    scene = load(
        sensor=camera(origin=(3 * sine, 3 * cosine, 0), target=(0, 0, 0), fov=0.2, size=4),
        lamp=square(emitter=area(1.0)) | {"to_world": facing},
        surface=square(turn=([1, 0, 0], -90), bsdf=bsdf),
        **{f"filter {i}": square(bsdf=one) | {"to_world": across} for i, one in enumerate(more)},
    )
    return layers(scene, bdpt(max_depth=8, skip="none"), 256).mean((0, 1))


def test_brewster():
    """At Brewster's angle glass reflects light that is polarized along the surface alone, of the unpolarized
    half ((n^2 - 1) / (n^2 + 1))^2. (Noise of choosing reflection: 3 %.)"""
    index = 1.5
    s0, s1, s2, s3 = mirrored(GLASS, np.degrees(np.arctan(index)))
    assert s1 == pytest.approx(s0, rel=1e-4) and max(abs(s2), abs(s3)) < 1e-3 * s0
    assert s0 == pytest.approx(0.5 * ((index**2 - 1) / (index**2 + 1)) ** 2, rel=0.05)


def reflectances(degrees):
    """Fresnel's reflectances of the metal, across and along the plane of incidence."""
    index, cos = complex(METAL["eta"], METAL["k"]), np.cos(np.radians(degrees))
    inside = np.sqrt(1 - (1 - cos**2) / index**2)
    across = (cos - index * inside) / (cos + index * inside)
    along = (index * cos - inside) / (index * cos + inside)
    return abs(across) ** 2, abs(along) ** 2


def test_a_mirror():
    """Of unpolarized light a mirror reflects (Rs + Rp) / 2, with S1 = (Rs - Rp) / 2."""
    across, along = reflectances(45)
    s0, s1, s2, s3 = mirrored(MIRROR, 45)
    assert s0 == pytest.approx((across + along) / 2, rel=1e-3)
    assert s1 == pytest.approx((across - along) / 2, rel=5e-3) and max(abs(s2), abs(s3)) < 1e-3


def test_total_internal_reflection():
    """Light polarized at 45 degrees to the plane of incidence leaves elliptic, by the phase delta with
    tan(delta / 2) = cos t sqrt(sin^2 t - 1 / n^2) / sin^2 t."""
    index, angle = 1.5, 54.0
    sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    delta = 2 * np.arctan(cosine * np.sqrt(sine**2 - index**-2) / sine**2)
    s0, s1, s2, s3 = mirrored(GLASS, angle, polarizer(45))
    assert s0 == pytest.approx(0.5, rel=1e-3)
    assert abs(s3) == pytest.approx(0.5 * np.sin(delta), rel=5e-3)
    assert abs(s2) == pytest.approx(0.5 * abs(np.cos(delta)), rel=5e-3) and abs(s1) < 2e-3


# -- Mitsuba's `stokes` as the judge ----------------------------------------------------------


def wall(reflectance):
    return scenes.ball(matte(reflectance), 3.0, flip_normals=True)


def room(*objects, **more):
    """A matte sphere from within with a lamp behind a polarizer, and objects."""
    eye = camera(origin=(0, -0.2, 2.6), target=(0, 0.1, 0), up=(0.2, 1, 0))
    tilted = [1, 0, 0], 80
    scene = {
        "sensor": eye,
        "wall": wall(0.6),
        "lamp": square((0.3, 1.4, 0.3), tilted, 0.8, emitter=area(3.0)),
        "sheet": square((0.28, 1.33, 0.3), tilted, 0.9, polarizer(40)),
    }
    return load(**scene | {f"object {i}": one for i, one in enumerate(objects)} | more)


def floor(bsdf, lift=0.0):
    return square((0, -0.8 + lift, 0), ([1, 0, 0], -80), 1.5, bsdf)


def ball(bsdf):
    return scenes.ball(bsdf, 0.45, (-0.5, -0.3, 0.3))


def sheet(bsdf, z):
    return square((0.1, 0, z), ([0, 1, 0], 15), 0.5, bsdf)


def foggy():
    """Mitsuba's phase functions leave Stokes vectors as they are."""
    fog = ball({"type": "null"}) | {"interior": parts.fog(2.0, 0.7)}
    return room(floor(ROUGH), fog, sheet={"type": "sphere", "center": [0, 5, 0], "radius": 0.01})


def polarized_sky():
    """Of the user's, seen directly, mirrored in rough metal and through glass."""
    parts.register_plugins()
    other = ball(PLASTIC) | {"center": [0.5, -0.3, 0.3]}
    eye, sky = camera(origin=(0, 0.5, 3), target=(0, -0.1, 0)), {"type": "rayleigh_sky"}
    return load(sensor=eye, sky=sky, floor=floor(ROUGH), ball=ball(GLASS), other=other)


def seen_through_glass(radius):
    """Rough metal under a polarizing foil, lit by a lamp in glass, seen through a pane: isolated paths."""
    lamp = ball(matte(0)) | {"radius": radius}
    to_world = transform().translate([0, -0.2, 2]).scale([0.8, 0.8, 0.03])
    return load(
        sensor=camera(origin=(0, -0.2, 2.6), target=(0, -0.3, 0)),
        wall=wall(0.0),
        floor=floor(ROUGH | {"alpha": 0.5}),
        foil=floor(polarizer(40), 0.03),
        glass=ball(GLASS),
        lamp=lamp | {"emitter": area(0.6 / radius**2)},
        pane={"type": "cube", "to_world": to_world, "bsdf": GLASS},
    )


ALL = {"skip": "none"}
WAYS = ALL, {"light_paths": 1, "connections": "one"}, {}
GOLD = {"type": "roughconductor", "alpha": 0.3, "material": "Au"}
FILTERS = sheet(retarder(20, 70), 1.2), sheet(polarizer(30), 0.9)
TWO_SIDES = floor({"type": "twosided", "nested": ROUGH})
MASK = {"type": "mask", "opacity": 0.6, "nested": PLASTIC}
# Scene, its integrator by Mitsuba, longest paths, our ways.
SCENES = {
    "rough metal and plastic": (lambda: room(floor(ROUGH), ball(PLASTIC)), "path", 5, WAYS),
    "mirror and filters": (lambda: room(floor(ROUGH), ball(MIRROR), *FILTERS), "path", 5, (ALL,)),
    "two sides, mask": (lambda: room(TWO_SIDES, ball(MASK)), "path", 5, WAYS[2:]),
    "gold in four wavelengths": (lambda: room(floor(GOLD), ball(GLASS)), "path", 4, (ALL,)),
    "fog": (foggy, "volpath", 5, (ALL,)),
    "a sky of the user's": (polarized_sky, "path", 4, (ALL,)),
    # `path` finds the lamp if it is large.
    "guided paths": (lambda: seen_through_glass(0.25), "path", 8, ({"guiding": "always"},)),
}


def tiles(scene, method, spp, first_seed):
    """Tile means of S0 to S3 of renders, (runs, tiles x values)."""
    found = []
    for seed in range(first_seed, first_seed + RUNS):
        image = np.array(mi.render(scene, integrator=method, spp=spp, seed=seed), dtype=np.float64)[..., -12:]
        found.append(st.tile_means(image if mi.is_spectral else image[..., FIRST], TILES))
    return np.stack(found).reshape(RUNS, -1)


@pytest.mark.parametrize("name", SCENES)
def test_stokes_vectors_are_mitsubas(name):
    """Frames, orders of matrices and their adjoints: S0 to S3 of every tile. Mitsuba's have many samples, for
    `path` seldom hits a lamp behind a sheet."""
    mi.set_variant(variants.of("spectral_polarized" if "wavelengths" in name else "mono_polarized"))
    make, kind, depth, ways = SCENES[name]
    scene, most = make(), {"rr_depth": 100, "max_depth": depth}
    method = mi.load_dict({"type": "stokes", "nested": {"type": kind} | most})
    theirs = tiles(scene, method, 2048, 5000)
    family = [
        st.compare_images(tiles(scene, bdpt(**most | way), 64, 100 * i), theirs, f"{name} {way}")
        for i, way in enumerate(ways)
    ]
    channels = 4 if len(theirs[0]) == 4 * TILES**2 else 12
    vectors = theirs.reshape(RUNS, -1, channels)[..., channels // 4 :]
    assert np.abs(vectors.mean(0)).max() > (0.3 if "sky" in name else 0.05 if len(ways) > 1 else 0)
    many = len(ways) > 1 or mi.is_spectral
    st.assert_agree(st.Comparisons.join(family), at_least=100 if many else 40 if "sky" in name else 30)


class StokesOfStrategies(sink.Image):
    """Keeps S1, S2 and S3 in the three numbers of a strategy's layers."""

    def add(self, kernel, c, total, start, shared):
        return super().add(kernel, replace(c, towards=-start.ray.d), total, start, shared)

    def _put_strategy(self, c, position, shared, u=None):
        weighted, unweighted = (
            self._polarized(polarization.scaled(value, shared.weight), shared, c.towards)[FIRST]
            for value in (c.weighted(), c.value)
        )
        self._film.put_strategy(position, weighted, unweighted, c, c.active, u)


def test_strategies_agree_in_every_component(monkeypatch):
    """A strategy of small weight could be wrong and not be seen in the sum: the unweighted image of (s, t)
    has the mean of the next one's."""
    depth = 4
    monkeypatch.setattr(rendering, "Image", StokesOfStrategies)
    around = {"type": "sphere", "flip_normals": True, "bsdf": {"type": "twosided", "nested": PLASTIC}}
    lamp = parts.lamp(emitter=area(5.0))
    other = {"type": "sphere", "center": [-0.3, -0.3, -0.3], "radius": 0.25, "bsdf": ROUGH | {"alpha": 0.5}}
    scene = load(sensor=camera(), wall=around, lamp=lamp, other=other)
    method = bdpt(skip="none", rr_depth=100, max_depth=depth, layers="stokes,strategies")

    def unweighted(first_seed):
        images = [st.tile_means(image, TILES) for image in renders(scene, method, 64, 32, first_seed)]
        found = np.stack(images)[..., -6 * len(strategies(depth)) :]
        found = found.reshape(32, TILES**2, -1, 2, 3)[:, :, :, 1]
        return {(s, t): found[:, :, i].reshape(32, -1) for i, (_, s, t) in enumerate(strategies(depth))}

    a, b = unweighted(0), unweighted(1000)
    pairs = [(s, k + 1 - s) for k in range(2, depth + 1) for s in range(k)]
    family = [st.compare_images(a[s, t], b[s + 1, t - 1], f"s={s} t={t}") for s, t in pairs]
    assert max(np.abs(a[pair].mean(0)).max() for pair in pairs) > 0.01
    st.assert_agree(st.Comparisons.join(family), at_least=200)


# -- with everything else ---------------------------------------------------------------------


def test_what_polarizes_nothing_is_as_in_other_variants():
    """To rounding in all but a hundredth of the pixels (a drawn connection may be another one)."""
    found = []
    for variant in ("mono", "mono_polarized"):
        mi.set_variant(variants.of(variant))
        scene = mi.cornell_box()
        scene["sensor"]["film"].update(width=24, height=24, rfilter={"type": "box"})
        stokes_layers = "stokes" if mi.is_polarized else ""
        method = {"type": "bdpt", "light_paths": 1, "connections": "one", "layers": stokes_layers}
        found.append(np.array(mi.load_dict(method).render(mi.load_dict(scene), spp=16, seed=3)))
    plain, polarized = found
    shown = polarized[..., : plain.shape[2]]
    assert np.isclose(shown, plain, rtol=1e-3, atol=1e-3 * plain.mean()).mean() > 0.99
    assert np.abs(polarized[..., -9:]).max() == 0


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_the_first_layer_is_the_image(rfilter):
    """With any filter, splats included; the layers have the names of Mitsuba's, and come first."""
    eye = camera(origin=(0, -0.2, 2.6), target=(0, 0.1, 0), rfilter=rfilter)
    method = bdpt(max_depth=4, skip="none", aovs="dd:depth", layers="stokes,variance")
    scene = room(floor(ROUGH), ball(GLASS), sensor=eye)
    image = np.array(method.render(scene, spp=8, seed=0))
    assert method.aov_names()[:13] == [*STOKES_NAMES, "dd.T"]
    assert mi.load_dict({"type": "stokes", "nested": {"type": "path"}}).aov_names() == list(STOKES_NAMES)
    colours = image.shape[2] - len(method.aov_names())
    np.testing.assert_allclose(image[..., colours], image[..., 0], rtol=1e-5)
    # Physical: no vector is longer than its intensity.
    vector = image[..., colours : colours + 12][..., FIRST]
    assert (np.linalg.norm(vector[..., 1:], axis=-1) <= vector[..., 0] * (1 + 1e-4) + 1e-6).all()


def test_isolated_paths_are_polarized():
    """Merged, which blurs, S0 to S3 are those of guided s = 0 in the mean of the image, within 4 standard
    errors. A twelfth of that image, most of which is the lamp itself, is merged, and it is polarized."""
    small = seen_through_glass(0.1)
    method = bdpt(max_depth=8, rr_depth=100, guiding="always")
    theirs = np.stack([layers(small, method, 512, 100 + i).mean((0, 1)) for i in range(RUNS)])
    method = bdpt(max_depth=8, rr_depth=100, merging=True, skip="none", layers="stokes,strategies")
    images = [np.array(method.render(small, spp=64, seed=i), dtype=np.float64) for i in range(16)]
    first = images[0].shape[2] - len(method.aov_names())
    mine = np.stack([image[..., first : first + 12][..., FIRST].mean((0, 1)) for image in images])
    merged = np.mean([image[..., -6] for image in images])
    assert merged > 0.05 * mine[:, 0].mean() and np.abs(mine[:, 1:].mean(0)).max() > 0.01 * mine[:, 0].mean()
    error = np.sqrt(mine.var(0, ddof=1) / len(mine) + theirs.var(0, ddof=1) / RUNS)
    assert (np.abs(mine.mean(0) - theirs.mean(0)) < 4 * error + 1e-7).all()


def test_frames_do_not_flip():
    """Mitsuba's frames flip where the world's z of a direction changes its sign, by rounding where a camera
    looks across that axis; S1 and S2 of such images are too small."""

    def seen(height):
        eye = camera("orthographic", size=8)
        eye["to_world"] = transform().look_at([2, 1.3, height], [0, 0, 0], [0, 0, 1]).scale(0.8)
        del eye["fov"]
        sphere = {"type": "sphere", "radius": 0.9, "bsdf": ROUGH | {"alpha": 0.5}}
        sun = {"type": "directional", "direction": [-0.2, -1, -0.6], "irradiance": 3.0}
        scene = load(sensor=eye, ball=sphere, sun=sun)
        return layers(scene, bdpt(max_depth=2), 256).mean((0, 1))

    level, down = seen(0.0), seen(0.005)
    assert np.abs(down[1:3]).min() > 0.008 * down[0]
    np.testing.assert_allclose(level, down, rtol=0.03, atol=1e-3 * down[0])


def test_spectra_of_sensors():
    """Spectra that polarize nothing are no matrices: a radiance meter measures its sky."""
    mi.set_variant(variants.of("spectral_polarized"))
    meter = {"type": "radiancemeter", "origin": [0, 0, 0], "direction": [0, 0, 1], "film": scenes.film(1)}
    scene = load(sensor=meter, sky={"type": "constant", "radiance": parts.rgb(1, 0.6, 0.3)})
    found = np.array(mi.load_dict({"type": "bdpt"}).render(scene, spp=4096)).ravel()[:3]
    np.testing.assert_allclose(found, [1, 0.6, 0.3], rtol=0.02)


def test_what_cannot_be_done_is_said():
    """Layers that a variant or film has not, and filters that edges would pass."""
    fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.7}
    scene = room(ball({"type": "null"}) | {"interior": fog})
    with pytest.raises(NotImplementedError, match="class LinearPolarizer polarizes what it lets pass"):
        bdpt().render(scene, spp=1)
    mi.set_variant(variants.of("mono"))
    with pytest.raises((ValueError, RuntimeError), match="layers=stokes needs a polarized variant"):
        bdpt()
    mi.set_variant(variants.of("spectral_polarized"))
    band = {"type": "spectrum", "value": [(400.0, 1.0), (700.0, 1.0)]}
    film = {"type": "specfilm", "width": 8, "height": 8, "band": band}
    scene = room(floor(ROUGH), sensor=camera() | {"film": film})
    with pytest.raises(NotImplementedError, match="layers=stokes is not possible with film"):
        bdpt().render(scene, spp=1)
    assert np.isfinite(np.array(mi.load_dict({"type": "bdpt"}).render(scene, spp=1))).all()
