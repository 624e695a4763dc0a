"""How much memory there is, and how much a film takes of it."""

import resource
import threading
from pathlib import Path

import mitsuba as mi
import pytest
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.image import film_limits
from mitsuba_bdpt.image.channels import Channels

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
    """Expected: the least limit of the groups of both versions; the machine's where none has one."""
    system("proc/self/cgroup", memberships)
    machine = memory.available()
    for name, text in limits.items():
        system(f"sys/fs/cgroup/{name}", text)
    found = memory.available()
    if expected is None:
        assert found == machine
    else:
        assert found.bytes == expected * GIB and found.limit.startswith("the control group's limit, ")


@pytest.mark.parametrize(
    ("kind", "words"), [(resource.RLIMIT_AS, "ulimit -v"), (resource.RLIMIT_DATA, "ulimit -d")]
)
def test_limits_of_the_process_count_what_it_takes_already(kind, words):
    """Expected: 64 MiB above what the process takes now leave 64 MiB at most."""
    name = {resource.RLIMIT_AS: "VmSize", resource.RLIMIT_DATA: "VmData"}[kind]
    before, taken = resource.getrlimit(kind), status(name)
    resource.setrlimit(kind, (taken + 64 * 2**20, before[1]))
    try:
        found = memory.available()
    finally:
        resource.setrlimit(kind, before)
    assert 0 < found.bytes <= 64 * 2**20 and words in found.limit


def test_what_was_asked_for_counts():
    """Expected: a limit that was set is the least of all, until it is taken back."""
    memory.set_limit(GIB / 4)
    try:
        assert memory.available() == memory.Available(GIB / 4, "the limit set by --memory")
    finally:
        memory.set_limit(None)
    assert memory.available().bytes > GIB / 4


def status(name):
    """A line of the process's status, in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


@pytest.mark.parametrize(
    "more",
    [{}, {"aovs": "a:albedo,b:sh_normal,d:depth"}, {"variance": True}],
    ids=["plain", "aovs", "variance"],
)
def test_a_film_takes_what_is_said_of_it(monkeypatch, more):
    """Rationale: what exceeds a limit ends the process by a signal.

    Expected: a render's peak of data grows by at most what its film is said to take; what was freed before
    may be used again, so there is no bound from below. Tolerance: 48 MiB for kernels and the scene, of 144 to
    360 MiB.
    """
    said, check = [], film_limits.check_film

    def noted(film, channels, variance):
        monkeypatch.setattr(memory, "available", lambda: memory.Available(0, "nothing"))
        with pytest.raises(ValueError, match="takes about") as caught:
            check(film, channels, variance)
        said.append(float(str(caught.value).split("takes about ")[1].split()[0]) * GIB)

    monkeypatch.setattr(film_limits, "check_film", noted)
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 1024, "height": 512}}
    camera["film"]["rfilter"] = {"type": "box"}
    scene = mi.load_dict({"type": "scene", "sensor": camera, "lamp": {"type": "constant"}})
    integrator = mi.load_dict({"type": "bdpt", "light_paths": 0, **more})
    before, peak, done = status("VmData"), [0], threading.Event()

    def watch():
        while not done.wait(0.002):
            peak[0] = max(peak[0], status("VmData"))

    thread = threading.Thread(target=watch)
    thread.start()
    integrator.render(scene, spp=8 if "variance" in more else 1, develop=False)
    done.set()
    thread.join()
    assert peak[0] - before <= said[0] + 48 * 2**20


def test_channels_of_a_film_are_those_of_its_sums():
    """Expected: an RGB film takes 288 bytes a pixel, as measured with a film of 1024 x 1024 pixels."""
    film = mi.load_dict({"type": "hdrfilm", "width": 64, "height": 64})
    memory.set_limit(288 * 64 * 64)
    try:
        film_limits.check_film(film, Channels(3, 0, 0), False)
        memory.set_limit(288 * 64 * 64 - 1)
        with pytest.raises(ValueError, match="64 x 64 pixels"):
            film_limits.check_film(film, Channels(3, 0, 0), False)
    finally:
        memory.set_limit(None)
