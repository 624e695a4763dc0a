"""The page of a sweep, as a browser shows it."""

import base64
import json
import re
import shutil
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.measure import page, tables

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian's package chromium)")

# Run in the page after its own script: what a user does, and what is then on the canvases and in the table.
PROBE = """
<script>
const seen = {};
function set(input, value) {
  input.value = value;
  input.dispatchEvent(new Event("input"));
}
function shown(canvas) {
  return [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data];
}
function sums(canvas) {
  const data = shown(canvas), width = canvas.width, halves = [0, 0];
  for (let i = 0; i < data.length; i += 4) {
    halves[(i / 4) % width < width / 2 ? 0 : 1] += data[i] + data[i + 1] + data[i + 2];
  }
  return halves;
}
const view = views[0];
view.draw();
seen.halves = sums(view.image);
set(view.split, 0);
seen.rightOnly = sums(view.image);
set(view.exposure, -4);
seen.dark = sums(view.image);
set(view.exposure, 0);
set(view.split, 100);
seen.leftOnly = sums(view.image);
set(view.exposure, -4);
seen.darkLabel = view.shown.value;
seen.errorMap = [0, 1].map(row => shown(view.error).slice(64 * row, 64 * row + 4));
set(view.right, "reference");
seen.noError = shown(view.error).slice(0, 4);
seen.label = view.image.getAttribute("aria-label");
const cells = () => [...document.querySelectorAll("#rows tbody tr")].map(row => row.children[0].textContent);
seen.rows = cells().length;
document.querySelectorAll("#rows th button")[5].click();
const lines = [...document.querySelectorAll("#rows tbody tr")];
const seconds = lines.map(row => Number(row.children[5].textContent));
seen.sorted = seconds.every((x, i) => i === 0 || seconds[i - 1] <= x);
seen.sort = document.querySelectorAll("#rows th")[5].getAttribute("aria-sort");
document.querySelectorAll("#rows th button")[6].click();
const errors = () => [...document.querySelectorAll("#rows tbody tr")].map(row => row.children[6].textContent);
seen.byBound = errors();
set(document.getElementById("filter"), "cornell_box");
seen.trimmed = errors();
seen.filtered = [...new Set(cells())];
seen.unlabelled = [...document.querySelectorAll("input, select")].filter(
  e => !e.closest("label") && !e.getAttribute("aria-label")).length;
const addresses = [...document.querySelectorAll("[src], link[href]")].map(e => e.src || e.href);
seen.outside = addresses.filter(address => !address.startsWith("data:"));
seen.errors = window.problems;
document.body.insertAdjacentHTML("afterbegin", `<pre id="seen">${JSON.stringify(seen)}</pre>`);
</script>
"""
WATCH = "<script>window.problems = []; addEventListener('error', e => problems.push(e.message));</script>"


def fake_scene(name, **images):
    height, width = next(iter(images.values())).shape[:2]
    return {
        "name": name,
        "width": width,
        "height": height,
        "mean": 0.5,
        "exposure": 0,
        "images": {key: page.encoded(image) for key, image in images.items()},
        "figures": {key: f"{key}: 64 spp" for key in images},
        "words": "It is a test.",
    }


def written(tmp_path, rows, scenes):
    data = {"columns": list(page.COLUMNS), "rows": rows, "scenes": scenes}
    text = page.filled(title="A sweep", answers={"box": "<1x>"}, report="", data=data)
    file = tmp_path / "page.html"
    file.write_text(
        text.replace("<head>", f"<head>{WATCH}").replace("</body>", f"{PROBE}</body>"), encoding="utf-8"
    )
    return file


def opened(file) -> dict:
    """What `PROBE` saw in headless Chromium."""
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000"]
    command += [f"--user-data-dir={file.parent / 'profile'}", "--dump-dom", f"file://{file}"]
    dom = subprocess.run(command, capture_output=True, text=True).stdout
    found = re.search(r'<pre id="seen">(.*?)</pre>', dom, re.DOTALL)
    assert found, dom[:2000]
    return json.loads(found[1])


@needs_browser
def test_the_page_in_a_browser(tmp_path):
    """No script error and no request; the divider shows one image or the other, exposure darkens (by 4 stops:
    a linear 0.25 from 137 to 34 of 255 in sRGB), the error map is dark where an image is the reference;
    headings sort, bounds as numbers, the filter filters; every input has a label."""
    grey, half, noise = (np.full((8, 16, 3), x) for x in (0.25, 0.0, 0.0))
    noise[::2] = 1.0
    scenes = [fake_scene("cornell_box", bdpt=grey, path=half, reference=grey + noise)]
    rows = [
        ["cornell_box", "bdpt", 64, 5, 64, 0.5, 1e-3, 1e-3, None, 0.2],
        ["cornell_box", "path", 64, 5, 90, 0.25, [1e-2, "≥"], 1e-2, 0.3, 0.2],
        ["open_sky </script>", "bdpt", 64, 5, 64, 0.125, 1e-3, 1e-3, None, 0.2],
    ]
    seen = opened(written(tmp_path, rows, scenes))
    assert seen["errors"] == [] and seen["outside"] == [] and seen["unlabelled"] == 0
    white = 255 * 3 * 8  # the divider's own column
    level = round(255 * (1.055 * 0.25 ** (1 / 2.4) - 0.055)) * 3 * 8 * 8
    assert seen["halves"] == [0, level - level // 8 + white]
    assert seen["rightOnly"] == [level - level // 8 + white, level] and seen["leftOnly"] == [0, 0]
    dark = round(255 * (1.055 * (0.25 / 16) ** (1 / 2.4) - 0.055)) * 3 * 8 * 8
    assert dark == 34 * 192 and seen["dark"] == [dark - dark // 8 + white, dark]
    assert seen["darkLabel"] == "-4 stops"
    # Even rows of the reference are brighter by 1 than `bdpt`, odd ones equal it.
    assert seen["errorMap"][1] == [68, 1, 84, 255] and seen["errorMap"][0][1] > 150
    assert seen["noError"] == [68, 1, 84, 255] and "reference right of it" in seen["label"]
    assert seen["rows"] == 3 and seen["sorted"] and seen["sort"] == "ascending"
    assert seen["filtered"] == ["cornell_box"]
    assert seen["trimmed"] == ["0.00100", "≥ 0.0100"] and seen["byBound"] == [
        "0.00100",
        "0.00100",
        "≥ 0.0100",
    ]


def test_a_page_of_the_users_is_not_overwritten(tmp_path, capsys):
    (tmp_path / "page.html").write_text("<title>mine</title>")
    assert main(["page", str(tmp_path)]) == 2
    assert "page.html' exists and was made by something else; move it away, or" in capsys.readouterr().err
    assert "<title>{{ title }}</title>" in page.FRAME.read_text()


def test_images_are_half_precision():
    """16-bit floats, row by row, values beyond their range at its end."""
    image = np.arange(12).reshape(2, 2, 3) / 7
    image[1, 1, 2] = 1e6
    back = np.frombuffer(base64.b64decode(page.encoded(image)), dtype="<f2").reshape(2, 2, 3)
    np.testing.assert_allclose(back[..., :2], image[..., :2], rtol=1e-3)
    assert back[1, 1, 2] == 65504


def test_the_page_holds_the_report():
    def draw(folder):
        (folder / "seconds.png").write_bytes(b"a plot")

    table = tables.table(["scene", "`a<b`"], [["x", "1"]])
    text = f"# Benchmark\n\nMade.\n\n## Cost\n\n{table}\n![over seconds](seconds.png)\n"
    made = page.reported(SimpleNamespace(text=lambda: text, draw=draw))
    assert "Benchmark" not in made and "<h2>Cost</h2>" in made and "<code>a&lt;b</code></th>" in made
    assert "<td>1</td>" in made and base64.b64encode(b"a plot").decode() in made and ".png" not in made
    assert 'alt="over seconds"' in made
