"""A page in a real browser without a window, for the tests of both reports."""

import functools
import http.server
import json
import re
import shutil
import subprocess
import threading

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WRAPPER = """<!DOCTYPE html><html><body><iframe src="report.html" style="width:%dpx;height:900px;border:0"></iframe>
<pre id="out"></pre><script>
addEventListener("load", () => {
  const inner = document.querySelector("iframe"), page = inner.contentDocument, images = [...page.images];
  const colours = images.map(image => {
    const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
    canvas.width = image.naturalWidth; canvas.height = image.naturalHeight; pen.drawImage(image, 0, 0);
    return new Set(new Uint32Array(pen.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
  });
  const texts = [...page.querySelectorAll("p, td, th, figcaption, dt, a, summary")];
  const root = page.documentElement;
  document.getElementById("out").textContent = JSON.stringify({
    images: images.length, shown: images.filter(i => i.complete && i.naturalWidth > 0 && i.clientWidth > 100).length,
    colours: Math.min(...colours), overflow: root.scrollWidth - root.clientWidth, width: root.clientWidth,
    font: Math.min(...texts.map(e => parseFloat(getComputedStyle(e).fontSize))),
    columns: new Set(images.slice(0, 2).map(i => Math.round(i.getBoundingClientRect().left))).size,
    title: page.title
  });
});
</script></body></html>"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


def in_a_browser(folder, width):
    """What a script finds in `folder/report.html` at a width; no error may stand in the console."""
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
    assert seen["colours"] > 20
    assert seen["font"] >= 13
    assert seen["columns"] == (1 if width == 390 else 2)
    return seen
