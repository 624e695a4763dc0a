"""Renders the job of scripts/peers.py with one renderer; needs that renderer and NumPy alone.

    PYTHON scripts/peers_adapters.py SCENE.npz JOB OUTPUT.npy    # JOB: JSON

A function per renderer takes the scene and the method and returns one that renders n samples per pixel.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import command_line
import numpy as np

SIZE = 128
ARRAYS = "points", "faces", "normals"
Render = Callable[[int, int], np.ndarray]  # image (SIZE, SIZE, 3) of n samples per pixel and a seed


def processor() -> float:
    """Processor seconds of this process and of those it has waited for."""
    return sum(os.times()[:4])


def mitsuba(scene: dict, method: dict) -> Render:
    import mitsuba_bdpt  # noqa: F401, I001 (before mitsuba: it chooses the LLVM library)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mi.file_resolver().append(scene["folder"])
    loaded = mi.load_string(scene["xml"], resolution=SIZE, parallel=False, optimize=False)
    integrator = mi.load_dict(method | {"max_depth": scene["max_depth"]})
    return lambda n, seed: np.array(mi.render(loaded, integrator=integrator, spp=n, seed=seed))[..., :3]


def blender(scene: dict, caustics: bool):
    """Fill Blender's scene; ``caustics``: shadow caustics of glass."""
    import bpy
    from mathutils import Matrix

    bpy.ops.wm.read_factory_settings(use_empty=True)
    world = bpy.context.scene
    nodes_of = {"diffuse": "BsdfDiffuse", "mirror": "BsdfGlossy", "glass": "BsdfGlass"}

    def added(data, to_world):
        thing = bpy.data.objects.new("", data)
        world.collection.objects.link(thing)
        thing.matrix_world = Matrix(to_world.tolist())
        return thing

    for shape in scene["shapes"]:
        kind, mesh, material = shape["kind"], bpy.data.meshes.new(""), bpy.data.materials.new("")
        mesh.from_pydata(shape["points"].tolist(), [], shape["faces"].tolist())
        if shape["smooth"]:
            mesh.shade_smooth()
            mesh.normals_split_custom_set_from_vertices(shape["normals"].tolist())
        material.use_nodes = True
        material.node_tree.nodes.clear()
        bsdf = material.node_tree.nodes.new("ShaderNode" + nodes_of[kind])
        bsdf.inputs["Color"].default_value = (*shape["colour"], 1)
        bsdf.inputs["Roughness"].default_value = 0
        if kind == "glass":
            bsdf.inputs["IOR"].default_value = shape["ior"]
        output = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
        material.node_tree.links.new(bsdf.outputs[0], output.inputs[0])
        mesh.materials.append(material)
        thing = added(mesh, np.eye(4))
        thing.cycles.is_caustics_caster = caustics and kind == "glass"
        thing.cycles.is_caustics_receiver = caustics and kind == "diffuse"
    for lamp in scene["lamps"]:
        light = bpy.data.lights.new("", "POINT" if lamp["kind"] == "PointLight" else "AREA")
        colour, frame = np.array(lamp["colour"]), np.array(lamp["to_world"])
        sizes = np.linalg.norm(frame[:3, :3], axis=0)
        frame[:3, :3] /= sizes
        if light.type == "POINT":
            light.energy, light.shadow_soft_size = 4 * np.pi * colour.max(), 0
        else:
            disk = lamp["kind"] == "Disk"
            light.shape = "ELLIPSE" if disk else "RECTANGLE"
            light.size, light.size_y = 2 * sizes[:2]
            light.energy = (np.pi if disk else 4) * np.pi * sizes[0] * sizes[1] * colour.max()
            frame[:3, 3] += 1e-3 * sizes[:2].min() * frame[:3, 2]  # before the lamp's black surface
        light.color = colour / colour.max()
        light.cycles.is_caustics_light = caustics
        frame[:3, 2] *= -1  # Blender's lamps shine along -z
        frame[:3, 1] = np.cross(frame[:3, 2], frame[:3, 0])
        added(light, frame).visible_camera = True
    frame = np.array(scene["camera"])
    frame[:3, [0, 2]] *= -1  # Blender's camera looks along -z
    camera = bpy.data.cameras.new("")
    camera.angle, camera.clip_start = np.radians(scene["fov"]), 1e-3
    world.camera = added(camera, frame)
    return world


def cycles(scene: dict, method: dict) -> Render:
    import bpy

    world = blender(scene, method.pop("caustics", False))
    world.render.engine, world.render.use_persistent_data = "CYCLES", True
    world.render.threads_mode, world.render.threads = "FIXED", 2
    world.render.resolution_x = world.render.resolution_y = SIZE
    settings, file = world.render.image_settings, f"{tempfile.gettempdir()}/{os.getpid()}.exr"
    settings.file_format, settings.color_depth, world.render.filepath = "OPEN_EXR", "32", file
    kinds = ("diffuse", "glossy", "transmission", "max")
    plain = {f"{kind}_bounces": scene["max_depth"] - 2 for kind in kinds}
    plain |= dict.fromkeys(["use_adaptive_sampling", "use_denoising"], False) | {"pixel_filter_type": "BOX"}
    plain |= dict.fromkeys(["blur_glossy", "sample_clamp_indirect", "light_sampling_threshold"], 0)
    for name, value in (plain | method).items():
        setattr(world.cycles, name, value)

    def rendered(n, seed):
        world.cycles.samples, world.cycles.seed = n, seed
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(file)
        image.colorspace_settings.name = "Non-Color"
        pixels = np.array(image.pixels[:], np.float32).reshape(SIZE, SIZE, 4)[::-1, :, :3]
        bpy.data.images.remove(image)
        return pixels

    return rendered


def luxcore(scene: dict, method: dict) -> Render:
    import pyluxcore as lux

    lux.Init()
    world, depth, camera = lux.Scene(), scene["max_depth"], np.array(scene["camera"])

    def properties(prefix, values):
        """Properties of a dictionary: of what ``prefix`` begins."""
        made = lux.Properties()
        for name, value in values.items():
            words = " ".join(map(str, np.ravel(value)))
            made.SetFromString(f"{prefix}{name} = {words}")
        return made

    view = {"type": "perspective", "fieldofview": scene["fov"], "up": camera[:3, 1], "autofocus.enable": 0}
    view |= {"lookat.orig": camera[:3, 3], "lookat.target": camera[:3, 3] + camera[:3, 2], "cliphither": 1e-3}
    view["screenwindow"] = [-1, 1, -1 - 2 / SIZE, 1 - 2 / SIZE]  # its images lie one pixel lower
    world.Parse(properties("scene.camera.", view))
    for i, shape in enumerate(scene["shapes"]):
        colour = shape["colour"]
        material = {
            "diffuse": {"type": "matte", "kd": colour},
            "mirror": {"type": "mirror", "kr": colour},
            "glass": {"type": "glass", "kr": colour, "kt": colour, "interiorior": shape["ior"]},
        }[shape["kind"]]
        if shape["radiance"]:
            material |= {"emission": shape["radiance"]}
        points, faces, normals = ([tuple(x) for x in shape[key].tolist()] for key in ARRAYS)
        world.DefineMesh(f"m{i}", points, faces, normals if shape["smooth"] else None, None, None, None)
        world.Parse(properties(f"scene.materials.m{i}.", material))
        world.Parse(properties(f"scene.objects.m{i}.", {"shape": f"m{i}", "material": f"m{i}"}))
    for i, lamp in enumerate(scene["lamps"]):
        if lamp["kind"] == "PointLight":
            values = {
                "type": "point",
                "gain": 4 * np.pi * np.array(lamp["colour"]),
                "position": np.array(lamp["to_world"])[:3, 3],
            }
            world.Parse(properties(f"scene.lights.{i}.", values))
    config = {f"path.pathdepth.{kind}": depth for kind in ("total", "diffuse", "glossy", "specular")}
    config |= {"film.width": SIZE, "film.height": SIZE, "film.filter.type": "NONE", "native.threads.count": 2}
    config |= {"path.maxdepth": depth, "light.maxdepth": depth, "film.outputs.1.type": "RGB"}
    config |= {"film.outputs.1.filename": "image.exr", "film.imagepipelines.0.0.type": "NOP"}
    config |= {"sampler.type": "SOBOL", "sampler.sobol.adaptive.strength": 0} | method

    def rendered(n, seed):
        stop = {"batch.haltspp": n, "renderengine.seed": seed}
        session = lux.RenderSession(lux.RenderConfig(properties("", config | stop), world))
        session.Start()
        while not session.HasDone():
            time.sleep(0.02)
            session.UpdateStats()
        session.Stop()
        image = np.zeros(SIZE * SIZE * 3, np.float32)
        session.GetFilm().GetOutputFloat(lux.FilmOutputType.RGB, image, 0)
        return image.reshape(SIZE, SIZE, 3)[::-1]

    return rendered


def smallvcm(scene: dict, method: dict) -> Render:
    file = f"{tempfile.gettempdir()}/{os.getpid()}.hdr"

    def rendered(n, seed):  # of one seed, which it has built in
        words = f"-s {scene['smallvcm']} -a {method['type']} -i {n} -o {file}".split()
        subprocess.run([scene["program"], *words], check=True, stdout=subprocess.DEVNULL)
        data = Path(file).read_bytes()[-12 * SIZE * SIZE :]  # rows from top to bottom
        return np.frombuffer(data, np.float32).reshape(SIZE, SIZE, 3)

    return rendered


def main() -> None:
    """Render the job: first a few samples; then as many as it says, or as take its seconds."""
    parser = command_line.parser(__doc__)
    for name, kind in (("scene", np.load), ("job", json.loads), ("output", Path)):
        parser.add_argument(name, type=kind)
    options = parser.parse_args()
    stored, job = options.scene, options.job
    scene = json.loads(str(stored["scene"])) | {"program": job["program"]}
    for i, shape in enumerate(scene["shapes"]):
        shape |= {name: stored[f"{name}{i}"] for name in ARRAYS}
    began = time.perf_counter()
    render = globals()[job["renderer"]](scene, job["method"])
    prepared = time.perf_counter()
    n, seed, taken = job["spp"] or 16, job["seed"] * 100, 0.0
    render(4, seed)
    first = time.perf_counter() - began
    while not taken or (not job["spp"] and taken < 0.8 * job["seconds"]):
        if taken:
            n = round(n * min(8, max(1.3, job["seconds"] / taken)))
        seed += 1
        cpu, started = processor(), time.perf_counter()
        image = render(n, seed)
        cpu, taken = processor() - cpu, time.perf_counter() - started
    np.save(options.output, image.astype(np.float32))
    figures = {"spp": n, "cpu": cpu, "wall": taken, "first": first, "prepared": prepared - began}
    print("ANSWER", json.dumps(figures), flush=True)
    os._exit(0)  # LuxCore's threads abort when Python ends


if __name__ == "__main__":
    main()
