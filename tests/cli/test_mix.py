"""The command `mix` and its function: new weights of light groups or path layers, from files."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt import CommandError, mix
from mitsuba_bdpt.cli.arguments import main

GROUPS = ("key", "sky")


PATHS = ("emission", "direct", "indirect", "caustic")


def rendered(path, alpha=False, groups=GROUPS, paths=()):
    """An EXR file as of a render with light groups and path layers; the groups by name."""
    found = {group: np.random.default_rng(i).random((3, 4, 3)) for i, group in enumerate(groups)}
    names, pixels = ["R", "G", "B"] + ["A"] * alpha, [sum(found.values(), np.zeros((3, 4, 3)))]
    pixels += [np.full((3, 4, 1), 0.5)] * alpha
    for group, layer in found.items():
        names += [f"groups.{group}.{colour}" for colour in "RGB"]
        pixels.append(layer)
    for number, layer in enumerate(paths):
        names += [f"path.{layer}.{colour}" for colour in "RGB"]
        pixels.append(np.full((3, 4, 3), 2.0**number))
    values = np.concatenate(pixels, axis=-1).astype(np.float32)
    mi.Bitmap(values, mi.Bitmap.PixelFormat.MultiChannel, names).write(str(path))
    return {group: layer.astype(np.float32) for group, layer in found.items()}


@pytest.mark.parametrize("alpha", [False, True])
def test_the_command_scales_the_layers(tmp_path, alpha):
    """Expected: an EXR of the scaled layers' sum, exactly, with the alpha of the image, and a PNG; a group
    that is left out keeps its weight."""
    layers = rendered(tmp_path / "a.exr", alpha)
    output = tmp_path / "mixed.exr"
    assert main(["mix", str(tmp_path / "a.exr"), "sky=0.2,0.5,0.25", "-o", str(output)]) == 0
    mixed = np.array(mi.Bitmap(str(output)))
    expected = (layers["key"] + layers["sky"] * np.array([0.2, 0.5, 0.25])).astype(np.float32)
    assert np.array_equal(mixed[..., :3], expected)
    assert mixed.shape[-1] == 3 + alpha and (mixed[..., 3:] == 0.5).all()
    assert np.array(mi.Bitmap(str(output.with_suffix(".png")))).shape == (3, 4, 3)


def test_a_png_lies_beside_the_image(tmp_path):
    """Expected: without an output the PNG is IMAGE.mixed.png; two stops more are four times the weights."""
    rendered(tmp_path / "a.exr")
    assert main(["mix", str(tmp_path / "a.exr"), "key=0.1", "sky=0.2", "--exposure", "2"]) == 0
    bright = np.array(mi.Bitmap(str(tmp_path / "a.mixed.png")))
    assert main(["mix", str(tmp_path / "a.exr"), "key=0.4", "sky=0.8", "-o", str(tmp_path / "b.png")]) == 0
    assert np.array_equal(bright, np.array(mi.Bitmap(str(tmp_path / "b.png"))))


def test_path_layers_are_mixed_like_groups(tmp_path):
    """Expected: weights of path layers scale these, beside light groups too; names may have the prefix of
    their kind."""
    rendered(tmp_path / "a.exr", groups=(), paths=PATHS)
    mixed = np.array(mix(tmp_path / "a.exr", {"caustic": 2, "direct": (0, 1, 1)}))
    assert (mixed == np.array([21.0, 23.0, 23.0])).all()
    layers = rendered(tmp_path / "b.exr", groups=("direct", "sky"), paths=PATHS)
    assert (np.array(mix(tmp_path / "b.exr", {"path.direct": 2, "caustic": 0})) == 9).all()
    mixed = np.array(mix(tmp_path / "b.exr", {"groups.direct": 0}))
    assert np.array_equal(mixed, layers["sky"])


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ({"direct": 2}, "has a light group and a path layer 'direct'; write groups.direct or path.direct"),
        ({"sky": 2, "caustic": 1}, "'sky' is one of the light groups and 'caustic' one of the path layers"),
        ({"caustics": 2}, "no layer 'caustics'; did you mean caustic. Light groups: direct, sky; Path l"),
        ({"caustic": 2, "path.caustic": 1}, "caustic has two weights"),
    ],
)
def test_weights_of_both_kinds(tmp_path, weights, words):
    """Expected: an error that names the layers and what to do."""
    rendered(tmp_path / "a.exr", groups=("direct", "sky"), paths=PATHS)
    with pytest.raises(CommandError, match=words):
        mix(tmp_path / "a.exr", weights)


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ({"kex": 2}, "has no layer 'kex'; did you mean key. Light groups: key, sky"),
        ({"key": (1, 2)}, "has 2 numbers; give one, or 3 for R, G, B"),
        ({"key": -1}, "key=-1 must be 0 or greater"),
        ({"key": float("nan")}, "key=nan must be 0 or greater, and finite"),
    ],
)
def test_what_cannot_be_mixed(tmp_path, weights, words):
    """Expected: an error that names the group, the value and what to do."""
    rendered(tmp_path / "a.exr")
    with pytest.raises(CommandError, match=words):
        mix(tmp_path / "a.exr", weights)


def test_images_that_cannot_be_mixed(tmp_path, capsys):
    """Expected: errors for no image, one without groups, and other files; by the command in one line."""
    rendered(tmp_path / "a.exr", groups=())
    with pytest.raises(CommandError, match="has no layers of light groups or paths; render it with light"):
        mix(tmp_path / "a.exr", {})
    (tmp_path / "b.exr").write_text("no image")
    with pytest.raises(CommandError, match="cannot be read"):
        mix(tmp_path / "b.exr", {})
    assert main(["mix", str(tmp_path / "c.exr"), "key=1"]) == 2
    assert "there is no image" in capsys.readouterr().err
    rendered(tmp_path / "a.exr")
    assert main(["mix", str(tmp_path / "a.exr"), "key=1", "key=2"]) == 2
    assert "key has two weights; give it one" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["mix", str(tmp_path / "a.exr"), "key"])
    assert "must have the form LAYER=X or LAYER=X,Y,Z" in capsys.readouterr().err
