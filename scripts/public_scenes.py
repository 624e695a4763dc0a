"""Scenes of other people at equal time: `path`, path tracing alone, everything switched on, and the default.

    python scripts/public_scenes.py ~/scenes -o results/public
    python scripts/public_scenes.py ~/scenes --scenes veach-bidir --reference veach-bidir=TungstenRender.exr

Scenes are FOLDER/NAME.xml, and FOLDER/NAME/ with scene_v3.xml, scene.xml, NAME.xml or one XML file alone (the
first of these that is there). Rendered are their first sensor, its whole film and no crop window, at the
`max_depth` of the file's integrator, of which nothing else is taken. The reference of a scene is NAME.exr
beside its file, or reference.exr in a folder of its own, in any case of letters, unless the file names that
as a texture; no other image is taken but by --reference. Where there is none `bdpt` makes one, with every
strategy; a further run goes on with it.

OUTPUT gets table.md, summary.md and page.html, beside all that a sweep leaves; finished renders are kept.
What cannot be rendered is named with the reason and left out. The exit status is 1 if a scene was left out,
or if a check finds that this package renders one wrongly.
"""

from __future__ import annotations

import argparse
import sys
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import definition, number
from mitsuba_bdpt.errors import CommandError, did_you_mean, message
from mitsuba_bdpt.files.images import read_layers
from mitsuba_bdpt.files.named import named_files
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.files.whole import check_own
from mitsuba_bdpt.measure import agreement, analysis, given, making, page, report, showing
from mitsuba_bdpt.measure.making import Job
from mitsuba_bdpt.measure.preset import Method, Preset, Subject
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.rows import write_tables
from mitsuba_bdpt.measure.scenes import SceneFile, depth_of
from mitsuba_bdpt.measure.sweep import Sweep
from mitsuba_bdpt.run.rendering import raise_interrupt
from public_table import DEFAULT, MARK, Findings
from repository import ROOT

import mitsuba as mi  # isort: skip

DEPTH = 16
"""The ``max_depth`` of scenes whose file has no integrator, or one that has none."""

FILES = ("scene_v3.xml", "scene.xml")
"""Names of scene files in folders of their own, beside that of the folder."""


def _ways() -> tuple[Method, ...]:
    """What renders: the default, whose seconds the others have, and Mitsuba's path tracers."""
    ours = {
        DEFAULT: {},
        analysis.NONE: {"skip": "none"},
        analysis.ALONE: {"light_paths": 0},
    }
    ways = [(name, {"type": "bdpt"} | more, None) for name, more in ours.items()]
    ways += [("path", {"type": "path"}, False), ("volpath", {"type": "volpath"}, True)]
    return tuple(
        Method(
            name=name,
            parameters=tuple(sorted(parameters.items())),
            sampler="independent",
            match="spp" if name == DEFAULT else "seconds",
            scenes=None,
            media=media,
            seeds=None,
        )
        for name, parameters, media in ways
    )


@dataclass(frozen=True)
class Found:
    """A scene of the folder: its file, and the image that is taken for its reference, if there is one."""

    scene: SceneFile
    reference: Path | None


def found_in(folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """The scene files in a folder by name, and what is left out there, with the reason."""
    if not folder.is_dir():
        raise CommandError(f"folder={str(folder)!r} is no folder; give one that holds scene files")
    files, left_out = {}, {}
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.suffix.lower() == ".xml":
            files[path.stem] = path
    for path in sorted(folder.iterdir()):
        there = sorted(path.glob("*.xml")) if path.is_dir() else []
        if not there:
            continue
        names = *FILES, f"{path.name}.xml"
        known = [path / name for name in names if path / name in there]
        if path.name in files:
            left_out[f"{path.name}/"] = f"{files[path.name].name} beside it has the same name; rename one"
        elif known or len(there) == 1:
            files[path.name] = (known or there)[0]
        else:
            listed = ", ".join(file.name for file in there)
            left_out[path.name] = f"several scene files: {listed}; call the one to render scene.xml"
    return files, left_out


def reference_beside(name: str, file: Path, folder: Path) -> Path | None:
    """The image that is taken for the reference of a scene, None if there is none."""
    wanted = [f"{name}.exr".lower(), *(["reference.exr"] if file.parent != folder else [])]
    there = [path for path in sorted(file.parent.iterdir()) if path.name.lower() in wanted]
    if not there:
        return None
    textures = {path.resolve() for path in named_files(file)}
    there = [path for path in there if path.resolve() not in textures]
    return min(there, key=lambda path: wanted.index(path.name.lower()), default=None)


def chosen(options: Namespace) -> tuple[dict[str, Path], dict[str, str]]:
    """`found_in` the folder, of these that the command line asks for."""
    files, left_out = found_in(options.folder)
    told = dict(options.reference)
    for option, names in (("--scenes", options.scenes or ()), ("--reference", told)):
        for name in names:
            if name not in files and name not in left_out:
                there = [*files, *left_out]
                raise CommandError(
                    f"{option} {name}: no scene of {str(options.folder)!r}, which has {', '.join(there)}; "
                    f"{did_you_mean(name, there)}".rstrip("; ")
                )
    for name, image in told.items():
        if name in files and not _told(files[name], image).is_file():
            raise CommandError(f"--reference {name}={image}: no such file, here or beside {files[name]}")
    if not files and not left_out:
        raise CommandError(
            f"folder={str(options.folder)!r} holds no scenes; they are NAME.xml or NAME/scene.xml in it"
        )
    if options.scenes:
        files, left_out = (
            {name: what for name, what in kept.items() if name in options.scenes}
            for kept in (files, left_out)
        )
    return files, left_out


def _told(file: Path, image: str) -> Path:
    """An image that --reference names, beside the scene's file or seen from here."""
    beside = file.parent / image
    return beside if beside.is_file() else Path(image)


def found(name: str, file: Path, options: Namespace) -> Found:
    """A scene with its reference as the command line ``options`` say."""
    told = dict(options.reference)
    if name in told:
        return Found(SceneFile(name, file), _told(file, told[name]))
    own = None if options.own_references else reference_beside(name, file, options.folder)
    return Found(SceneFile(name, file), own)


def subject_of(scene: SceneFile, options: Namespace) -> tuple[Subject, int]:
    """A scene as it is rendered, and the width of its image."""
    width, height = scene.size()
    wanted = options.resolution * width / max(width, height)
    fitting = making.nearest_width(scene, wanted)
    if fitting is None:
        raise CommandError(
            f"no size near {options.resolution} divides its film of {width} x {height} into 4 x 4 tiles; "
            "take a larger --resolution"
        )
    integrator = scene.load().integrator()
    told = hasattr(integrator, "max_depth") or "max_depth" in str(integrator)
    depth = options.max_depth or (depth_of(integrator) if told else DEPTH)
    return Subject(scene, depth, (options.spp,), (options.seeds,)), fitting


def referenced(job: Job, image: Path | None) -> Reference:
    """The reference of a scene: the ``image`` that is given, or one that is made, or gone on with, now."""
    if image is not None:
        return given.adopt(job, image)
    given.forget(job)
    print(f"{job.scene.name}: its reference, for at most about {job.seconds:g} s", flush=True)
    return making.make(job)[0]


def rows_of(one: Found, options: Namespace, project: Project) -> list[dict]:
    """The rows of all renders of a scene; raises an error if one of them cannot be had."""
    subject, width = subject_of(one.scene, options)
    enough = agreement.FEWEST_RUNS // 2
    seconds = options.reference_seconds
    job = Job(project, one.scene, width, subject.max_depth, options.spp, seconds, by="bdpt", rounds=enough)
    reference = referenced(job, one.reference)
    preset = Preset((subject,), _ways(), width, None, {})
    sweep = Sweep(project, preset, project.root)
    print(f"{one.scene.name}: {width} wide, max_depth {subject.max_depth}", flush=True)
    with showing.bar() as progress:
        sweep.run(progress)
    rows = sweep.rows()
    if sweep.failed:
        others = f" (and {len(sweep.failed) - 1} more like it)" if len(sweep.failed) > 1 else ""
        raise CommandError(f"{sweep.failed[0]}{others}")
    if not reference.given:
        return rows
    return given.judged(rows, given.own_error(reference.image, _by_seed(project.root, rows)))


def _by_seed(output: Path, rows: list[dict]) -> list[np.ndarray]:
    """The mean of our renders of each seed, which share random numbers, without path tracing alone."""
    found: dict[int, list[np.ndarray]] = {}
    for row in rows:
        if row["method"] in (DEFAULT, analysis.NONE):
            (image,), _ = read_layers(output / "images" / row["scene"] / f"{row['key']}.exr", "")
            found.setdefault(row["seed"], []).append(image)
    return [np.mean(images, axis=0) for images in found.values()]


def measured(options: Namespace, project: Project) -> tuple[list[dict], dict[str, str]]:
    """The rows of all scenes, and by name why others are left out."""
    files, left_out = chosen(options)
    rows = []
    for name, file in files.items():
        try:
            rows += rows_of(found(name, file, options), options, project)
        except Exception as error:  # one scene must not cost the others
            raise_interrupt(error)
            left_out[name] = " ".join(message(error).split())
            print(f"{name}: left out: {left_out[name]}", flush=True)
    return rows, left_out


def parser() -> argparse.ArgumentParser:
    """That of the command line."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = made.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder with scenes")
    add("-o", "--output", type=Path, help="folder; default: results/NAME_OF_FOLDER of the repository")
    add("--scenes", nargs="+", metavar="NAME", help="these alone")
    add("--spp", type=number(int, 1), default=64, help="of the default; default: %(default)s")
    text = "renders of each; bias is checked from 8 on; default: %(default)s"
    add("--seeds", type=number(int, 2), default=16, help=text)
    text = "the longer side of the images, about; default: %(default)s"
    add("--resolution", type=number(int, 8), default=256, metavar="PIXELS", help=text)
    text = f"of all scenes; default: that of a scene's file, {DEPTH} where it tells none"
    add("--max-depth", type=number(int, 1), help=text)
    text = "that making a reference may take, per scene; default: %(default)g"
    add("--reference-seconds", type=number(float, 0), default=600.0, metavar="SECONDS", help=text)
    text = "take this EXR for the reference of a scene (may be repeated)"
    add("--reference", type=definition, action="append", default=[], metavar="NAME=FILE", help=text)
    add("--own-references", action="store_true", help="take no image beside a scene: make all references")
    return made


def main(arguments=None) -> int:
    """Render what is missing, and write table, summary and page."""
    options = parser().parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    folder = options.output or ROOT / "results" / options.folder.resolve().name
    files = {name: folder / name for name in ("table.md", "summary.md", "page.html")}
    for name, mark in (("table.md", MARK), ("summary.md", MARK), ("page.html", f"<title>{page.TITLE}")):
        check_own(files[name], mark, "move it away, or name another folder by -o")
    rows, left_out = measured(options, Project(folder))
    if not rows:
        print(f"{folder}: no scene could be rendered")
        return 1
    write_tables(rows, folder)
    findings = Findings(*report.load(Project(folder), folder), left_out)
    write_text(files["table.md"], findings.tables())
    write_text(files["summary.md"], findings.summary())
    page.run(Namespace(project=folder, folder=str(folder), output=None))
    print(files["table.md"], files["summary.md"], sep="\n", end=f"\n\n{findings.words()}")
    return int(bool(left_out or findings.wrong()))


if __name__ == "__main__":
    sys.exit(answered(main))
