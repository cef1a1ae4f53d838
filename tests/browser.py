"""A page in a real browser without a window, for the tests of reports: seen, zoomed, pointed at and switched.

axe-core, which checks accessibility, is run where the environment variable AXE_CORE names its script (axe.min.js of the
npm package `axe-core`).
"""

import functools
import http.server
import json
import os
import re
import shutil
import subprocess
import threading
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
WRAPPER = """<!DOCTYPE html><html><body><iframe src="report.html" style="width:%dpx;height:900px;border:0"></iframe>
<pre id="out"></pre><script>
const wait = time => new Promise(done => setTimeout(done, time));
const colours = canvas => new Set(new Uint32Array(
  canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
function drawn(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
  canvas.getContext("2d").drawImage(image, 0, 0);
  return canvas;
}
async function used(frame, chart) {  // what a reader does with a chart, and what comes of it
  const over = chart.querySelector(".u-over"), place = over.getBoundingClientRect(), range = () => chart.dataset.range;
  const mouse = (type, x, y, target = over) => target.dispatchEvent(new frame.MouseEvent(type, {
    bubbles: true, buttons: 1, movementX: 9,
    clientX: place.left + x * place.width, clientY: place.top + y * place.height }));
  const key = key => chart.dispatchEvent(new frame.KeyboardEvent("keydown", { key, bubbles: true }));
  const home = range(), out = {};
  mouse("mousemove", 0.5, 0.5); await wait(60);
  out.tip = chart.querySelector(".tip").textContent;
  mouse("mousedown", 0.2, 0.5); mouse("mousemove", 0.6, 0.52); mouse("mouseup", 0.6, 0.52, frame.document);
  await wait(60);
  out.zoomed = range() !== home;
  mouse("dblclick", 0.5, 0.5); await wait(60);
  out.returned = range() === home;
  key("+"); out.keys = range() !== home;
  key("0"); key("ArrowRight"); await wait(60);
  out.spoken = chart.querySelector("output").textContent;
  const button = chart.querySelector(".legend button"), canvas = chart.querySelector("canvas");
  const before = canvas.toDataURL();
  if (button) {
    button.click(); await wait(60);
    out.off = button.getAttribute("aria-pressed") === "false" && canvas.toDataURL() !== before;
    button.click(); await wait(60);
    out.on = button.getAttribute("aria-pressed") === "true";
  }
  return out;
}
addEventListener("load", async () => {
  const frame = document.querySelector("iframe").contentWindow, page = frame.document, root = page.documentElement;
  await wait(200);
  const charts = [...page.querySelectorAll(".chart")];
  const images = [...page.images].filter(i => i.clientWidth > 0), plots = [...page.querySelectorAll(".chart canvas")];
  const texts = [...page.querySelectorAll("p, td, th, figcaption, dt, a, summary, button")].filter(e => e.clientWidth);
  const seen = {
    title: page.title, width: root.clientWidth, overflow: root.scrollWidth - root.clientWidth,
    pictures: page.querySelectorAll("figure:not(.replaced)").length,
    carried: page.querySelectorAll("[data-chart]").length,
    charts: plots.filter(c => c.clientWidth > 200 && colours(c) > 20).length,
    images: images.filter(i => i.complete && i.clientWidth > 100 && colours(drawn(i)) > 20).length,
    font: Math.min(...texts.map(e => parseFloat(frame.getComputedStyle(e).fontSize))),
    columns: new Set([...page.querySelectorAll(".pictures:not(.wide):not(.alone) > figure")].slice(0, 2).map(
      i => Math.round(i.getBoundingClientRect().left))).size,
    used: [], violations: [],
  };
  for (const chart of charts) seen.used.push(await used(frame, chart));
  const grave = v => ["serious", "critical"].includes(v.impact);
  if (frame.axe) seen.violations = (await frame.axe.run()).violations.filter(grave).map(v => [v.id, v.nodes[0].html]);
  document.getElementById("out").textContent = JSON.stringify(seen);
});
</script></body></html>"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


def in_a_browser(folder, width):
    """What a script finds in `folder/report.html` at a width; the console is clean and every chart works."""
    if axe := os.environ.get("AXE_CORE"):  # the page's policy would not let it in
        html = (folder / "report.html").read_text()
        head = f"<head><script>{Path(axe).read_text()}</script>"
        html = re.sub('<meta http-equiv="Content-Security-Policy".*?>', "", html).replace("<head>", head)
        (folder / "report.html").write_text(html)
    (folder / "wrapper.html").write_text(WRAPPER % width)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    flags += " --disable-component-update --disable-sync --hide-scrollbars --enable-logging=stderr --dump-dom"
    flags += f" --window-size={width + 40},1000 --virtual-time-budget=20000 --user-data-dir={folder / 'profile'}"
    address = f"http://127.0.0.1:{server.server_address[1]}/wrapper.html"
    try:
        done = subprocess.run(
            [CHROMIUM, *flags.split(), address], capture_output=True, text=True, timeout=120, check=True
        )
    finally:
        server.shutdown()
        server.server_close()
    assert "CONSOLE" not in done.stderr, done.stderr
    seen = json.loads(re.search(r'<pre id="out">(.*?)</pre>', done.stdout, re.S).group(1))
    assert seen["width"] == width and seen["overflow"] <= 0
    assert seen["font"] >= 13
    assert seen["columns"] == (1 if width == 390 else 2)
    assert seen["charts"] == seen["carried"] == len(seen["used"]) > 0
    assert seen["charts"] + seen["images"] == seen["pictures"]
    works = ("zoomed", "returned", "keys", "off", "on")
    broken = [u for u in seen["used"] if not all(u.get(k, True) for k in works)]
    assert not broken, broken
    assert sum(bool(u["tip"]) for u in seen["used"]) > len(seen["used"]) / 2  # a cloud may have no point in its middle
    assert seen["violations"] == []
    return seen
