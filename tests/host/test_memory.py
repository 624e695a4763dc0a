"""How much memory there is, and how much a film takes of it."""

import json
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import pytest
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.image import film_limits
from mitsuba_bdpt.image.accumulator import Channels

GIB = 2**30


@pytest.fixture
def system(tmp_path, monkeypatch):
    """The files of another system, and a function that writes one of them."""
    monkeypatch.setattr(memory, "ROOT", tmp_path)

    def write(name, text):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    write("proc/self/status", "Name:\tpython\nVmSize:\t1048576 kB\nVmData:\t 524288 kB\n")
    return write


@pytest.mark.parametrize(
    ("memberships", "limits", "expected"),
    [
        ("0::/\n", {"memory.max": "max\n"}, None),
        ("0::/\n", {"memory.max": "1073741824\n"}, 1),
        # Of a slot within the group of a job the tighter limit counts, whichever it is.
        ("0::/job/slot\n", {"job/slot/memory.max": "3221225472", "job/memory.max": "2147483648"}, 2),
        ("0::/job/slot\n", {"job/slot/memory.max": "1073741824", "job/memory.max": "max"}, 1),
        # A container sees its own group at the mount, under the path that the machine knows.
        ("0::/machine/of/host\n", {"memory.max": "1073741824"}, 1),
        ("4:memory:/job\n3:cpuset:/\n0::/\n", {"memory/job/memory.limit_in_bytes": "1073741824"}, 1),
        ("4:cpu,memory:/job\n", {"memory/memory.limit_in_bytes": "2147483648"}, 2),
        ("4:memory:/\n", {"memory/memory.limit_in_bytes": "9223372036854771712"}, None),
    ],
)
def test_limits_of_control_groups_count(system, memberships, limits, expected):
    system("proc/self/cgroup", memberships)
    machine = memory.available()
    for name, text in limits.items():
        system(f"sys/fs/cgroup/{name}", text)
    found = memory.available()
    if expected is None:
        assert found == machine
    else:
        assert found.bytes == expected * GIB and found.limit.startswith("the control group's limit, ")


# In a process of its own the films of `FILMS`, the largest last, since a peak is that of all before it, and
# then limits. Kernels are compiled before, with a film of 16 x 8 pixels. VmHWM is the peak of the resident
# memory; ru_maxrss would be that of the process which has begun this one, too.
CHILD = """
import gc, json, resource, sys
import mitsuba_bdpt, mitsuba as mi, drjit as dr
from mitsuba_bdpt.host import memory

mi.set_variant("llvm_ad_rgb")

def status(name):
    lines = open("/proc/self/status").read().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name + ":"))

def render(integrator, width):
    film = {"type": "hdrfilm", "width": width, "height": width // 2, "rfilter": {"type": "box"}}
    parts = {"sensor": {"type": "perspective", "film": film}, "lamp": {"type": "constant"}}
    scene = mi.load_dict({"type": "scene", **parts})
    integrator.render(scene, spp=8 if integrator.settings.variance else 3, develop=False)
    dr.sync_thread()

def said(integrator):
    memory.set_limit(1)
    try:
        render(integrator, WIDTH)
    except ValueError as error:
        return float(str(error).split("takes about ")[1].split()[0]) * 2**30
    finally:
        memory.set_limit(None)

WIDTH, found = 1024, {"films": [], "limits": {}}
every = {"type": "bdpt", "light_paths": 1, "connections": "none", "spp_per_pass": 1}
ways = [mi.load_dict(every | more) for more in json.loads(sys.argv[1])]
for integrator in ways:
    render(integrator, 16)
gc.collect()
dr.flush_malloc_cache()
before = status("VmRSS")
for integrator in ways:
    render(integrator, WIDTH)
    found["films"].append({"said": said(integrator), "taken": status("VmHWM") - before})
    gc.collect()
    dr.flush_malloc_cache()
for option, kind, name in (("-v", resource.RLIMIT_AS, "VmSize"), ("-d", resource.RLIMIT_DATA, "VmData")):
    usual = resource.getrlimit(kind)
    resource.setrlimit(kind, (status(name) + 64 * 2**20, usual[1]))
    left = memory.available()
    resource.setrlimit(kind, usual)
    found["limits"][option] = [left.bytes, left.limit]
print(json.dumps(found))
"""

FILMS = {"plain": {}, "aovs": {"aovs": "a:albedo,b:sh_normal,d:depth"}, "variance": {"layers": "variance"}}


@pytest.fixture(scope="module")
def child():
    """What `CHILD` has found: its films, and its limits by the option of ``ulimit``."""
    command = [sys.executable, "-c", CHILD, json.dumps(list(FILMS.values()))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("option", ["-v", "-d"])
def test_limits_of_the_process_count_what_it_takes_already(child, option):
    """One more stack of a thread, 8 MiB, may have come between."""
    left, limit = child["limits"][option]
    assert 48 * 2**20 < left <= 64 * 2**20 and limit == f"the process's limit, ulimit {option}"


def test_the_peak_is_of_this_process_alone(system):
    """On Linux ``ru_maxrss`` is at least what the process had that began this one."""
    assert 2**26 < memory.peak() < 2**46
    system("proc/self/status", "Name:\tpython\nVmHWM:\t2048 kB\n")
    assert memory.peak() == 2 * 2**20


def test_what_was_asked_for_counts():
    memory.set_limit(GIB / 4)
    try:
        assert memory.available() == memory.Available(GIB / 4, "the limit set by --memory")
    finally:
        memory.set_limit(None)
    assert memory.available().bytes > GIB / 4


@pytest.mark.parametrize("name", FILMS)
def test_a_film_takes_what_is_said_of_it(child, name):
    """What exceeds a limit ends the process by a signal. Tolerances: measured are 0.97 to 1.01 of it; 32 MiB
    above for what else a render takes."""
    film = child["films"][list(FILMS).index(name)]
    assert 0.9 * film["said"] <= film["taken"] <= film["said"] + 32 * 2**20


def test_channels_of_a_film_are_those_of_its_sums(monkeypatch):
    """192 bytes a pixel, as measured; with a wide filter another 48 for each thread, unless these copies are
    too large to be made."""
    copies = 4 * (4 + 8) * dr.thread_count()
    narrow, wide = {"type": "gaussian"}, {"type": "gaussian", "stddev": 1}
    for rfilter, most, of_a_pixel in ((narrow, GIB, 192), (wide, GIB, 192 + copies), (wide, 1, 192)):
        monkeypatch.setattr(film_limits, "COPIES_MEMORY", most)
        film = mi.load_dict({"type": "hdrfilm", "width": 1024, "height": 1024, "filter": rfilter})
        memory.set_limit(of_a_pixel * 1024 * 1024)
        try:
            film_limits.check_film(film, Channels(3, 0, 0), False)
            memory.set_limit(of_a_pixel * 1024 * 1024 - 1)
            with pytest.raises(ValueError, match="1024 x 1024 pixels"):
                film_limits.check_film(film, Channels(3, 0, 0), False)
        finally:
            memory.set_limit(None)
