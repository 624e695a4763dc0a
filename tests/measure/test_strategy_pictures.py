"""Pictures of single strategies: the command `pyramid`."""

import re

import matplotlib.image
import numpy as np
import OpenEXR
import pytest
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.measure import pyramid
from mitsuba_bdpt.measure.project import Project
from repository import PROJECT
from support.measured import ROOM


def test_pyramid(tmp_path, capsys):
    """An EXR whose layers OpenEXR finds by the names of the contract, whose weighted ones add up to the image
    (float32: 1e-4), and two pictures of the pyramid with a row for k = 2 and one for k = 3."""
    file = tmp_path / "room.xml"
    file.write_text(ROOM)
    output = tmp_path / "made" / "room.v2.exr"
    options = ["--max-depth", "3", "--spp", "8", "--resolution", "16"]
    assert main(["pyramid", str(file), "-o", str(output), *options]) == 0
    said = capsys.readouterr().out.split()
    assert said == [str(output.with_name(f"room.v2_{kind}.png")) for kind in ("weighted", "unweighted")]
    with OpenEXR.File(str(output), separate_channels=True) as opened:
        channels = {name: np.array(c.pixels, dtype=float) for name, c in opened.channels().items()}
    for channel in "RGB":
        layers = [v for k, v in channels.items() if k.startswith("weighted.") and k.endswith("." + channel)]
        assert len(layers) == 12  # 3 + 4 + 5 of 1, 2 and 3 edges
        np.testing.assert_allclose(sum(layers), channels[channel], rtol=1e-4, atol=1e-5)
        assert f"unweighted.s2t2.{channel}" in channels
    assert main(["pyramid", str(file), "-o", str(tmp_path / "a.pdf"), "--columns", "1", *options]) == 0
    assert (tmp_path / "a.exr").stat().st_size == output.stat().st_size
    assert (tmp_path / "a_unweighted.pdf").read_bytes().startswith(b"%PDF")
    for name in said:
        picture = matplotlib.image.imread(name)[..., :3]
        height, width = picture.shape[:2]
        assert width > 400 and height > 400 and 0.02 < picture.mean() < 0.98


@pytest.mark.parametrize(
    ("dark", "options", "message"),
    [
        (False, ["-o", "room"], "output='room' must end in .exr"),
        (
            False,
            ["--max-depth", "17"],
            "the image has 1126 channels, 1122 of them layers, and .* 1023 at most",
        ),
        (True, [], "nothing to draw: no path of 2 edges or more brings light"),
    ],
)
def test_what_cannot_be_drawn_leaves_no_file(tmp_path, monkeypatch, capsys, dark, options, message):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "room.xml"
    file.write_text(ROOM.replace("3, 2, 1", "0") if dark else ROOM)
    assert main(["pyramid", str(file), "--spp", "1", "--resolution", "4", *options]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path != file]


def test_panels_have_all_strategies():
    names = [f"weighted.s{s}t{k + 1 - s}.{c}" for k in (1, 2, 3) for s in range(k + 2) for c in "RGB"]
    image = np.zeros((2, 2, 3 + len(names)))
    for name in ("weighted.s0t2.R", "weighted.s1t2.G"):
        image[..., 3 + names.index(name)] = 1
    image[0, 0, 3 + names.index("weighted.s2t2.B")] = 1
    images = pyramid.technique_images(image, names, "weighted")
    assert images[2, 1, 2].shape == (2, 2, 3) and len(images) == 12
    found = pyramid.panels(images)
    assert len(found) == 9 and {key for key, one in found.items() if one is not None} == {
        (2, 1, 2),
        (3, 2, 2),
    }


def test_scenes_by_name_or_file(tmp_path):
    assert PROJECT.scene("cornell_box").file.name == "cornell_box.xml"
    assert PROJECT.scene("scenes/small_casters/area_cube.xml").name == "area_cube"
    file = tmp_path / "cornell_box"
    file.write_text(ROOM)
    assert PROJECT.scene(str(file)).file == file
    for name in ("nothing", "scenes/nothing"):
        with pytest.raises(ValueError, match=f"scene='{name}' is neither .* there are ajar_door, "):
            PROJECT.scene(name)
    with pytest.raises(ValueError, match="give the path of an XML file, or put it into .*scenes'"):
        Project(tmp_path).scene("nothing")
