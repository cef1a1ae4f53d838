"""A page in a real browser without a window, for the tests of reports: seen, zoomed, pointed at, switched and printed.

The browser is Chromium, found on the PATH or named by the environment variable CHROMIUM, and driven through a pipe by
its own protocol (https://chromedevtools.github.io/devtools-protocol). axe-core, which checks accessibility, is run
where the environment variable AXE_CORE names its script (axe.min.js of the npm package `axe-core`).
"""

import contextlib
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell", "chromium-headless-shell")
CHROMIUM = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
PATIENCE = 120  # seconds for one command: axe-core takes seconds on a long page, more on a busy machine
WIDTHS = (390, 1280, 1920)  # pixels: a telephone, a notebook, a large screen
FLAGS = [
    "--headless",
    "--remote-debugging-pipe",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
]
LAUNCH = "import os, sys; a = sys.argv; os.dup2(int(a[1]), 3); os.dup2(int(a[2]), 4); os.execv(a[3], a[3:])"
SEEN = """(async () => {
const wait = () => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
const colours = canvas => new Set(new Uint32Array(
  canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
function drawn(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
  canvas.getContext("2d").drawImage(image, 0, 0);
  return canvas;
}
async function used(chart) {  // what a reader does with a chart, and what comes of it
  const over = chart.querySelector(".u-over");
  chart.scrollIntoView({ block: "center" });
  const place = over.getBoundingClientRect(), range = () => chart.dataset.range;
  const mouse = (type, x, y, target = over) => target.dispatchEvent(new MouseEvent(type, {
    bubbles: true, buttons: 1, movementX: 9,
    clientX: place.left + x * place.width, clientY: place.top + y * place.height }));
  const key = key => chart.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  const home = range(), out = {};
  mouse("mousemove", 0.5, 0.5); await wait();
  out.tip = chart.querySelector(".tip").textContent;
  for (let k = 0; k < 400 && !out.tip; k++) {  // a cloud may have no point in its middle
    mouse("mousemove", (k % 20 + 0.5) / 20, (Math.floor(k / 20) + 0.5) / 20); await null;
    out.tip = chart.querySelector(".tip").textContent;
  }
  mouse("mousedown", 0.2, 0.5); mouse("mousemove", 0.6, 0.52); mouse("mouseup", 0.6, 0.52, document);
  await wait();
  out.zoomed = range() !== home;
  mouse("dblclick", 0.5, 0.5); await wait();
  out.returned = range() === home;
  key("+"); out.keys = range() !== home;
  key("0"); key("ArrowRight"); await wait();
  out.spoken = chart.querySelector("output").textContent;
  const button = chart.querySelector(".legend button"), canvas = chart.querySelector("canvas");
  const before = canvas.toDataURL();
  if (button) {
    button.click(); await wait();
    out.off = button.getAttribute("aria-pressed") === "false" && canvas.toDataURL() !== before;
    button.click(); await wait();
    out.on = button.getAttribute("aria-pressed") === "true";
  }
  return out;
}
await wait();
const root = document.documentElement, charts = [...document.querySelectorAll(".chart")];
const plots = [...document.querySelectorAll(".chart canvas")];
const visible = all => [...document.querySelectorAll(all)].filter(e => e.clientWidth > 0);
const images = visible("img"), texts = visible("p, td, th, figcaption, dt, a, summary, button");
const seen = {
  title: document.title, width: root.clientWidth, overflow: root.scrollWidth - root.clientWidth,
  pictures: document.querySelectorAll("figure:not(.replaced)").length,
  carried: document.querySelectorAll("[data-chart]").length,
  charts: plots.filter(c => c.clientWidth > 200 && colours(c) > 20).length,
  images: images.filter(i => i.complete && i.clientWidth > 100 && colours(drawn(i)) > 20).length,
  font: Math.min(...texts.map(e => parseFloat(getComputedStyle(e).fontSize))),
  columns: new Set([...document.querySelectorAll(".pictures:not(.wide):not(.alone) > figure")].slice(0, 2).map(
    i => Math.round(i.getBoundingClientRect().left))).size,
  paper: getComputedStyle(document.body).backgroundColor, used: [], violations: [],
};
for (const chart of charts) seen.used.push(await used(chart));
scrollTo(0, 0);
const grave = v => ["serious", "critical"].includes(v.impact);
if (window.axe) seen.violations = (await axe.run()).violations.filter(grave).map(v => [v.id, v.nodes[0].html]);
return seen;
})()"""
PICTURES = """(() => {
const visible = all => [...document.querySelectorAll(all)].filter(e => e.clientWidth > 0).length;
const figures = document.querySelectorAll("figure").length;
return { figures, images: visible("figure img"), charts: visible(".chart") };
})()"""
FOCUS = """(() => {
const e = document.activeElement, place = e.getBoundingClientRect(), look = getComputedStyle(e);
return e === document.body ? null : {
  name: e.className || e.localName, shown: place.bottom > 0 && place.top < innerHeight,
  outline: look.outlineStyle !== "none" && parseFloat(look.outlineWidth) >= 1 };
})()"""


class Browser:
    """A running Chromium with one page; `messages` are the errors and warnings of the page's console."""

    def __init__(self, profile):
        self.buffer, self.count, self.session, self.messages, self.events = b"", 0, None, [], []
        (its_in, self.commands), (self.answers, its_out) = os.pipe(), os.pipe()
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (its_in, its_out)]  # it expects 3 and 4
        self.process = subprocess.Popen(
            [sys.executable, "-c", LAUNCH, *map(str, ends), CHROMIUM, *FLAGS, f"--user-data-dir={profile}"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=ends,
        )
        for end in (its_in, its_out, *ends):
            os.close(end)
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.send("Emulation.setFocusEmulationEnabled", enabled=True)
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def close(self):
        with contextlib.suppress(Exception):
            self.session = None
            self.send("Browser.close")
            self.process.wait(10)
        self.process.kill()
        self.process.wait()
        os.close(self.commands)
        os.close(self.answers)

    def send(self, method, **params):
        """Send a command and return its result."""
        self.count += 1
        session = {"sessionId": self.session} if self.session else {}
        os.write(
            self.commands,
            json.dumps({"id": self.count, "method": method, "params": params, **session}).encode() + b"\0",
        )
        while True:
            answer = self._read(method)
            if answer.get("id") == self.count:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _read(self, awaited):
        """Return the next message of the browser; remember it if it is a message of the console."""
        end = time.monotonic() + PATIENCE
        while b"\0" not in self.buffer:
            ready, _, _ = select.select([self.answers], [], [], max(end - time.monotonic(), 0))
            assert ready, f"No answer to {awaited} within {PATIENCE} s; the console says {self.messages}."
            part = os.read(self.answers, 1 << 20)
            assert part, f"The browser ended before it answered {awaited}; the console says {self.messages}."
            self.buffer += part
        text, self.buffer = self.buffer.split(b"\0", 1)
        message = json.loads(text)
        method, params = message.get("method"), message.get("params", {})
        self.events.append(method)
        if method == "Runtime.exceptionThrown":
            self.messages.append(_error_text(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.messages.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.messages.append(params["entry"]["text"])
        return message

    def open(self, path, width=1280, dark=False, first="", scripts=True):
        """Open a page of a width in pixels; `first` is a script that runs before those of the page."""
        self.messages.clear()
        self.events.clear()
        self.send("Emulation.setScriptExecutionDisabled", value=not scripts)
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        self.look(dark)
        script = self.send("Page.addScriptToEvaluateOnNewDocument", source=first)["identifier"]
        self.send("Page.navigate", url=Path(path).absolute().as_uri())
        while "Page.loadEventFired" not in self.events:
            self._read("Page.navigate")
        self.send("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
        return self

    def look(self, dark=False, media=""):
        """Set whether the reader prefers a dark page, and the medium, such as `print`."""
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.send("Emulation.setEmulatedMedia", media=media, features=features)

    def run(self, script):
        """Return the value of a script in the page; a script that throws is an `AssertionError` with its text."""
        answer = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, (_error_text(answer["exceptionDetails"]), self.messages)
        return answer["result"].get("value")

    def press_tab(self):
        key = {"key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
        self.send("Input.dispatchKeyEvent", type="rawKeyDown", **key)
        self.send("Input.dispatchKeyEvent", type="keyUp", **key)


def _error_text(details):
    return details.get("exception", {}).get("description") or details["text"]


@contextlib.contextmanager
def browser():
    """Start a browser and end it."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        found = Browser(profile)
        try:
            yield found
        finally:
            found.close()


def in_a_browser(path, widths=WIDTHS, first=""):
    """What a script finds on a page at each width, light and dark; the page works, by keyboard and in print too."""
    assert path.stat().st_size <= 3_000_000
    axe = Path(os.environ["AXE_CORE"]).read_text() if os.environ.get("AXE_CORE") else "undefined"
    out = []
    with browser() as b:
        for width in widths:
            for dark in (False, True):
                b.open(path, width, dark, first)
                b.run(f"{axe}; undefined")
                seen = b.run(SEEN)
                assert b.messages == []
                check(seen, width)
                out.append(seen)
        assert len({seen["paper"] for seen in out}) == 2  # a light one and a dark one
        check_keyboard(b.open(path, widths[0]))
        b.look(dark=True, media="print")
        shown = b.run(PICTURES)
        assert shown["images"] == shown["figures"] and shown["charts"] == 0
        shown = b.open(path, scripts=False).run(PICTURES)
        assert shown["images"] == shown["figures"] and shown["charts"] == 0
    return out


def check(seen, width):
    """Check what was seen at a width."""
    assert seen["width"] == width and seen["overflow"] <= 0
    assert seen["font"] >= 13
    assert seen["columns"] == (1 if width == 390 else 2)
    assert seen["charts"] == seen["carried"] == len(seen["used"]) > 0
    assert seen["charts"] + seen["images"] == seen["pictures"]
    works = ("tip", "zoomed", "returned", "keys", "off", "on")
    broken = [u for u in seen["used"] if not all(u.get(k, True) for k in works)]
    assert not broken, broken
    assert seen["violations"] == []


def check_keyboard(b):
    """Go through a fresh page with the Tab key: the focus is always visible, and it comes to the first chart."""
    names = []
    for _ in range(60):
        b.press_tab()
        focus = b.run(FOCUS)
        if focus is None:
            break
        assert focus["shown"] and focus["outline"], focus
        names.append(focus["name"])
    assert "chart" in names, names
