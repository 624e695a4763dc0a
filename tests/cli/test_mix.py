"""The command `mix` and its function: new weights of light groups or path layers, from files."""

import json
import sys

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt import CommandError, mix
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.files.images import attribute

GROUPS = ("key", "sky")


PATHS = ("emission", "direct", "indirect", "caustic")


def rendered(path, alpha=False, groups=GROUPS, paths=(), features=(), lamps=None):
    """An EXR file as of a render with light groups and path layers; the groups by name. ``features``: other
    channels; ``lamps``: ids by group, as the command writes them."""
    found = {group: np.random.default_rng(i).random((3, 4, 3)) for i, group in enumerate(groups)}
    names, pixels = ["R", "G", "B"] + ["A"] * alpha, [sum(found.values(), np.zeros((3, 4, 3)))]
    pixels += [np.full((3, 4, 1), 0.5)] * alpha
    for group, layer in found.items():
        names += [f"groups.{group}.{colour}" for colour in "RGB"]
        pixels.append(layer)
    for number, layer in enumerate(paths):
        names += [f"path.{layer}.{colour}" for colour in "RGB"]
        pixels.append(np.full((3, 4, 3), 2.0**number))
    names += features
    pixels.append(np.full((3, 4, len(features)), 9.0))
    values = np.concatenate(pixels, axis=-1).astype(np.float32)
    image = mi.Bitmap(values, mi.Bitmap.PixelFormat.MultiChannel, names)
    if lamps is not None:
        image.metadata()["bdptStatistics"] = json.dumps({"light_groups": lamps})
    image.write(str(path))
    return {group: layer.astype(np.float32) for group, layer in found.items()}


@pytest.mark.parametrize("alpha", [False, True])
def test_the_command_scales_the_layers(tmp_path, alpha):
    layers = rendered(tmp_path / "a.exr", alpha)
    output = tmp_path / "mixed.exr"
    assert main(["mix", str(tmp_path / "a.exr"), "sky=0.2,0.5,0.25", "-o", str(output)]) == 0
    mixed = np.array(mi.Bitmap(str(output)))
    expected = (layers["key"] + layers["sky"] * np.array([0.2, 0.5, 0.25])).astype(np.float32)
    assert np.array_equal(mixed[..., :3], expected)
    assert mixed.shape[-1] == 3 + alpha and (mixed[..., 3:] == 0.5).all()
    assert np.array(mi.Bitmap(str(output.with_suffix(".png")))).shape == (3, 4, 3)


def test_path_layers_are_mixed_like_groups(tmp_path):
    rendered(tmp_path / "a.exr", groups=(), paths=PATHS)
    mixed = np.array(mix(tmp_path / "a.exr", {"caustic": 2, "direct": (0, 1, 1)}))
    assert (mixed == np.array([21.0, 23.0, 23.0])).all()
    layers = rendered(tmp_path / "b.exr", groups=("direct", "sky"), paths=PATHS)
    assert (np.array(mix(tmp_path / "b.exr", {"path.direct": 2, "caustic": 0})) == 9).all()
    mixed = np.array(mix(tmp_path / "b.exr", {"groups.direct": 0}))
    assert np.array_equal(mixed, layers["sky"])


def test_names_may_be_patterns(tmp_path):
    names = ("lamp-key", "lamp-fill", "emit")
    layers = rendered(tmp_path / "a.exr", groups=names, paths=PATHS)

    def check(weights, **expected):
        factors = {name: expected.get(name.replace("-", ""), 1) for name in names}
        mixed = sum(np.float64(layers[name]) * factor for name, factor in factors.items())
        np.testing.assert_allclose(np.array(mix(tmp_path / "a.exr", weights)), mixed, rtol=1e-6)

    check({"lamp-*": 2}, lampkey=2, lampfill=2)
    check({"lamp-*": 2, "lamp-key": 5}, lampkey=5, lampfill=2)
    check({"groups.?amp-k*": 2}, lampkey=2)
    check({"groups.*": 2}, **{name.replace("-", ""): 2 for name in names})
    assert (np.array(mix(tmp_path / "a.exr", {"c*": 2, "*direct": 0})) == 17).all()


def test_without_weights_the_layers_are_listed(tmp_path, capsys):
    lamps = {"A_1_2": [["A.1", "bulb"]], "desk": [["Key Light"], ["Lämpchen=1"]], "none": []}
    rendered(tmp_path / "a.exr", groups=lamps, paths=PATHS, lamps=lamps)
    assert main(["mix", str(tmp_path / "a.exr")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "groups.desk: Key Light, Lämpchen=1" in lines and "path.caustic" in lines
    assert "groups.A_1_2: A.1 (bulb)" in lines and "groups.none: no emitter (black)" in lines
    assert len(lines) == len(lamps) + len(PATHS) and not (tmp_path / "a.mixed.png").exists()


def test_a_mix_records_its_weights(tmp_path):
    rendered(tmp_path / "a.exr")
    assert main(["mix", str(tmp_path / "a.exr"), "k*=0.5,1,2", "-o", str(tmp_path / "b.exr")]) == 0
    assert json.loads(attribute(tmp_path / "b.exr", "bdptMix") or "") == {"groups.key": [0.5, 1, 2]}
    again = mix(tmp_path / "a.exr", {"groups.sky": 3})
    for one in (tmp_path / "b.exr", again):
        with pytest.raises(CommandError, match="has no layers of light groups or paths; .*, not a mix"):
            mix(one, {"key": 1})
    metadata = again.metadata()
    assert json.loads(metadata["bdptMix"]) == {"groups.sky": [3, 3, 3]}


def test_a_denoised_render_is_mixed_with_its_noise(tmp_path, capsys):
    """A line says so where the file has a denoised image, and none elsewhere."""
    for features, count in (((), 0), ([f"denoised.{c}" for c in "RGB"], 1)):
        rendered(tmp_path / "a.exr", features=features)
        assert main(["mix", str(tmp_path / "a.exr"), "key=2", "-o", str(tmp_path / "b.png")]) == 0
        error = capsys.readouterr().err
        assert error.count("note: the layers are not denoised") == count == error.count("\n")


def test_weights_may_be_colours(tmp_path):
    layers = rendered(tmp_path / "a.exr")
    expected = layers["sky"] + layers["key"] * np.array([1.0, 2.0, 3.0])
    for weight in (mi.Color3f(1, 2, 3), mi.ScalarColor3f(1, 2, 3), [1, 2, 3]):
        mixed = np.array(mix(tmp_path / "a.exr", {"key": weight}))
        np.testing.assert_allclose(mixed, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ({"direct": 2}, "groups.direct, path.direct are light groups and path layers, .*; mix one kind at a"),
        ({"caustic": 2, "path.caustic": 1}, "caustic has two weights, by 'caustic' and 'path.caustic'; give"),
        ({"c*": 2, "*ic": 1}, r"caustic has two weights, by 'c\*' and '\*ic'"),
        ({"*": 0}, r"write groups.NAME or path.NAME"),
        ({"st": 2}, "has no layer 'st'; did you mean caustic"),
        ({"skx": 2}, "has no layer 'skx'; did you mean sky. there are groups.direct, groups.sky"),
        ({"sky": (1, 2)}, r"sky=\(1, 2\) must be a number, or one for each of R, G, B, of 0 to 1e.20"),
        ({"sky": float("nan")}, "sky=nan must be"),
        ({"sky": 1e40}, r"sky=1e\+40 must be"),
        ({"sky": "2"}, "sky='2' must be"),
        ({"torch*": 2, "sky": 1}, r"no layer 'torch\*'"),
    ],
)
def test_what_cannot_be_mixed(tmp_path, weights, words):
    rendered(tmp_path / "a.exr", groups=("direct", "sky"), paths=PATHS)
    with pytest.raises(CommandError, match=words):
        mix(tmp_path / "a.exr", weights)


def test_images_that_cannot_be_mixed(tmp_path):
    rendered(tmp_path / "a.exr", groups=())
    (tmp_path / "b.exr").write_text("no image")
    tensor = mi.TensorXf(np.zeros((3, 4, 9), dtype=np.float32))
    for image, words in (
        (tmp_path / "a.exr", "has no layers of light groups or paths; give the EXR"),
        (mi.Bitmap(tensor), r"no layers .* film\(\).bitmap\(\) .* or a tensor"),
        (tmp_path / "b.exr", "is not an EXR"),
    ):
        with pytest.raises(CommandError, match=words):
            mix(image, {"key": 1})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.exr", "key=1"], "none.exr': No such file or directory"),
        (["a.exr", "-m", "none"], "variant='none' is not one of Mitsuba's"),
        (["a.exr", "key=1", "key=2"], "a layer of key has two weights; give it one"),
        (["a.exr", "key=1", "-o", "b.jpg"], "b.jpg' must end in .png or .exr"),
        (["a.exr", "key=1", "-o", ""], "output='.' must end in .png or .exr"),
        (["", "key=1"], "'.': "),
        (["a.exr", "key"], "must have the form LAYER=X or LAYER=X,Y,Z"),
    ],
)
def test_mistakes_of_the_command(tmp_path, arguments, words, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rendered("a.exr")
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(["mix", *arguments]))
    assert words in capsys.readouterr().err


def test_features_are_no_layers(tmp_path):
    features = [f"groups.{c}" for c in "RGB"] + ["path.T", "groups.n.X", "groups.n.Y", "groups.n.Z"]
    layers = rendered(tmp_path / "a.exr", features=features)
    assert np.array_equal(np.array(mix(tmp_path / "a.exr", {"key": 0})), layers["sky"])
    with pytest.raises(CommandError, match="no layer 'n'; there are groups.key, groups.sky$"):
        mix(tmp_path / "a.exr", {"n": 2})


@pytest.mark.parametrize("depth", ["", "Z"])
@pytest.mark.parametrize(
    ("own", "colours"), [("RGB", "RGB"), ("Y", "RGB"), ("XYZ", "RGB"), (("low", "high"), ("low", "high"))]
)
def test_layers_have_the_colours_of_the_film(own, colours, depth):
    names = [*dict.fromkeys([*own, *depth]), "A", *(f"path.direct.{c}" for c in colours)]
    pixels = np.full((2, 2, len(names)), 2.0, dtype=np.float32)
    mixed = mix(mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, names), {"direct": 3})
    assert [channel.name for channel in mixed.struct_()] == [*colours, "A"]
    assert (np.array(mixed) == [6.0] * len(colours) + [2.0]).all()


def test_a_layer_of_weight_0_is_left_out(tmp_path):
    pixels = np.full((2, 2, 9), 1.0, dtype=np.float32)
    pixels[..., :6] = np.inf
    names = ["R", "G", "B", *(f"groups.{g}.{c}" for g in GROUPS for c in "RGB")]
    image = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, names)
    assert (np.array(mix(image, {"key": 0})) == 1).all()
    assert (np.array(mix(image, {"key": 0, "sky": 0})) == 0).all()


@pytest.mark.parametrize("output", ["a.exr", "A/../a.exr", "link.exr", "a.png"])
def test_a_mix_does_not_replace_its_image(tmp_path, output, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "A").mkdir()
    rendered(tmp_path / "a.exr")
    (tmp_path / "link.exr").symlink_to("a.exr")
    before = (tmp_path / "a.exr").read_bytes()
    assert main(["mix", "a.exr", "key=0.5", "-o", output]) == 2
    assert f"output={output!r}: the mix would replace" in capsys.readouterr().err
    assert (tmp_path / "a.exr").read_bytes() == before and not (tmp_path / "a.png").exists()
