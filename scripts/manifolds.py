"""Scenes of two papers on manifold walks, converted to Mitsuba 3 and measured in equal processor time.

    git clone https://github.com/tizian/specular-manifold-sampling sms
    git clone https://github.com/mollnn/manifold-path-guiding mpg
    python scripts/manifolds.py sms mpg FOLDER

Converts `plane`, `sphere` and `pool` of specular manifold sampling (Zeltner et al. 2020, figures 14 and 15)
and `mpg_plane` and `stone` of manifold path guiding (Fan et al. 2023, figures 7 and 14) into FOLDER/scenes,
renders them, and writes docs/reports/manifolds.json. The authors' integrators become `path` of their
max_depth, without marks of casters and receivers: all light is rendered, also what theirs leave out; filters
become `box`. Textures that a checkout lacks become gray of 0.5; normal maps and meshes are left out.
"""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

import command_line
import repository
from mitsuba_bdpt import measure
from mitsuba_bdpt.files.texts import write_json, write_text
from mitsuba_bdpt.measure.estimates import KINDS
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.report import Report

FIGURES = "results/Figure_14_15_MainComparison"
SMS = {name: f"{FIGURES}/{name}_pt.xml" for name in ("plane", "sphere", "pool")}
MPG = {"mpg_plane": "scenes/plane/plane_reproduce_fig07.xml", "stone": "scenes/stone/stone_reproduce.xml"}
SQUARE = ("plane", "sphere")  # measured in the square in the middle of the film
WAYS = [
    {"type": "bdpt"},
    {"type": "path"},
    {"type": "path", "name": "path multijitter", "sampler": "multijitter"},
]
NORMALS = """<texture name="normalmap" type="bitmap"><boolean name="raw" value="true"/>
<string name="filename" value="{}"/><transform name="to_uv"><scale value="{}"/></transform></texture>"""


def convert(node: ElementTree.Element, folder: Path) -> ElementTree.Element | None:
    """An element of a scene of the authors' Mitsuba 2 as one of Mitsuba 3; None without meaning there."""
    own = {one.get("name"): one.get("value", "") for one in node}
    file = folder / own.get("filename", "")
    if node.get("name", "").startswith(("caustic_", "crop_")) or (node.tag == "shape" and not file.exists()):
        return None
    if node.tag == "integrator":
        node.set("type", "path")
        node[:] = [one for one in node if one.get("name") == "max_depth"]
    elif node.tag == "rfilter":
        node.set("type", "box")
    elif node.get("type") == "normalmap":
        (nested,) = (one for one in node if one.tag == "bsdf")
        if not file.is_file():
            return convert(nested, folder)
        node[:] = [nested, ElementTree.fromstring(NORMALS.format(file, own.get("tiles", "1")))]
    elif node.get("type") == "bitmap":
        node.tag = "texture"
        if not file.is_file():
            return ElementTree.Element("rgb", {"name": node.get("name", ""), "value": "0.5"})
    elif node.get("name") == "filename":
        node.set("value", str(folder / node.get("value", "")))
    node[:] = [one for child in node if (one := convert(child, folder)) is not None]
    return node


def scene(file: Path, square: bool) -> str:
    """The XML of a converted scene."""
    text = file.read_text().replace("$normalmap", "textures/normalmap_pool.exr")
    if square:
        text = text.replace('name="width" value="1920"', 'name="width" value="1080"')
    return ElementTree.tostring(convert(ElementTree.fromstring(text), file.parent.resolve()), "unicode")


def efficiencies(project: Project) -> dict:
    """Mean samples, seconds, errors and means by scene and way, and the efficiency of `bdpt` over the way."""
    results = Report.of(project, project.root / "results" / "sweep").results
    found: dict = {}
    for name, way in product(results.scenes, results.methods):
        rows = results.of(name, way)
        row = {key: float(rows[key].mean()) for key in ("spp", "seconds", "mean", *KINDS)}
        if way != results.methods[0]:
            row |= {f"{kind} efficiency": str(results.efficiency(name, way, e)) for e, kind in KINDS.items()}
        found.setdefault(name, {})[way] = row
    return found


def main() -> None:
    """Convert, render, write."""
    parser = command_line.parser(__doc__)
    parser.add_argument("sms", type=Path, help="checkout of specular-manifold-sampling")
    parser.add_argument("mpg", type=Path, help="checkout of manifold-path-guiding")
    parser.add_argument("folder", type=Path, help="where scenes, references and results go")
    parser.add_argument("--reference-seconds", type=float, default=600.0, help="per scene; default: 600")
    options = parser.parse_args()
    project = Project(options.folder)
    for folder in (project.scenes, project.references):
        folder.mkdir(parents=True, exist_ok=True)
    for checkout, files in ((options.sms, SMS), (options.mpg, MPG)):
        for name, file in files.items():
            (project.scenes / f"{name}.xml").write_text(scene(checkout / file, name in SQUARE))
    names = [*SMS, *MPG]
    recipes = "".join(f'[{name}]\nby = "merging"\n' for name in names)
    write_text(project.references / "scenes.toml", recipes)
    preset = {"scenes": names, "spp": [64], "seeds": 3, "clock": "processor", "integrator": WAYS}
    measure.run_sweep(preset, project=options.folder, reference_seconds=options.reference_seconds)
    write_json(repository.ROOT / "docs" / "reports" / "manifolds.json", efficiencies(project))


if __name__ == "__main__":
    sys.exit(main())
