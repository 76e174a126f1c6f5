"""Look at reports in a real browser: ``python tools/look.py FOLDER``; needs Chromium, and pdftoppm for the paper.

Makes the reports of emulated measurements: with hostile names and two hundred notes, of one that ends early, of three
axes at 2,000 samples/s, of a triad without a stage, of one in the south that points north, and of a campaign; renders
each at 1280 and 390 px, light and dark, and on A4; leaves the pictures in FOLDER, to be looked at; and fails if a page

* asks for anything beyond itself, or says anything on the browser's console,
* is wider than the window, or has texts that overlap, or that are cut.
"""

from __future__ import annotations

import argparse
import html
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

from long_record import write_record

from drivers.api import DeviceIdentity

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTHS = (1280, 390)
SCHEMES = {"light": [], "dark": ["--blink-settings=preferredColorScheme=0"]}
#: Whatever a device or an operator might call itself, to do harm or to break the page.
HOSTILE = (
    "</style><script>document.title='taken'</script><img src=http://example.invalid/x onerror=alert(1)>"
    "\x1b]52;c;QUJD\x07\u202e\u2066 {{ 7 * 7 }} ${7*7} & \" ' `"
)
HOSTILE_NAME = "<svg/onload=alert(2)>" + "W" * 180

#: Schemes of what stays within the browser; files are looked at one by one.
_INTERNAL = {"data", "chrome", "devtools", "about", "chrome-extension", "file"}

#: Measures a page within the browser; writes what is wrong into it, for --dump-dom.
MEASURE = """
<script>
const found = [];
const width = document.documentElement.clientWidth;
if (document.documentElement.scrollWidth > width) found.push('the page is wider than the window: '
  + document.documentElement.scrollWidth + ' of ' + width);
const texts = [];
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
for (let node = walker.nextNode(); node; node = walker.nextNode()) {
  const parent = node.parentElement;
  if (!node.textContent.trim() || ['SCRIPT', 'STYLE'].includes(parent.tagName)) continue;
  if (parent.closest('.scroll')) continue;
  const range = document.createRange();
  range.selectNodeContents(node);
  for (const box of range.getClientRects()) {
    if (box.width < 1 || box.height < 1) continue;
    const inset = box.height * 0.22;  // above and below the letters there is room
    texts.push({text: node.textContent.trim().slice(0, 40), left: box.left, right: box.right,
                top: box.top + inset, bottom: box.bottom - inset, node});
    if (box.right > width + 1 || box.left < -1) found.push('cut at the edge: ' + node.textContent.slice(0, 40));
  }
}
for (let i = 0; i < texts.length; i++) for (let k = i + 1; k < texts.length; k++) {
  const a = texts[i], b = texts[k];
  if (a.node !== b.node && a.left + 1 < b.right && b.left + 1 < a.right && a.top < b.bottom && b.top < a.bottom)
    found.push('overlap: ' + a.text + ' / ' + b.text);
}
for (const each of document.querySelectorAll('.mark b')) if (each.scrollWidth > each.clientWidth + 1)
  found.push('cut: ' + each.textContent);
if (document.title.includes('taken')) found.push('a script of the record has run');
const height = document.documentElement.scrollHeight;
parent.postMessage(JSON.stringify({texts: texts.length, height, found: [...new Set(found)]}), '*');
</script>
"""
#: Holds a page in a frame of a telephone's width: the browser's own window is never narrower than 500 px.
FRAME = """<!doctype html>
<meta charset="utf-8">
<title>measured</title>
<body style="margin: 0">
<script>
onmessage = (event) => { document.body.innerHTML = '<pre id="measured"></pre>'; measured.textContent = event.data; };
</script>
<iframe style="border: 0; width: WIDTHpx; height: 100px" srcdoc="PAGE"></iframe>
"""


def browser() -> str | None:
    """Return the browser's command, None where there is none."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def make_pages(folder: Path) -> dict[str, Path]:
    """Return the pages to look at, by name."""
    records = {name: folder / f"{name}.sqlite" for name in ("hostile", "early", "axes")}
    gyro = DeviceIdentity(kind="gyro", model=HOSTILE, serial_number=HOSTILE_NAME, firmware_version="\x00\n")
    meta = {"northfinder": HOSTILE, "plan": {"name": HOSTILE}, "config": {"gyro": {"address": HOSTILE}}}
    meta |= {"identities": {"gyro": gyro}}
    events = [("note", HOSTILE), (HOSTILE_NAME, HOSTILE), *[("note", "a lorry passed")] * 210]
    write_record(records["hostile"], seconds=240.0, sample_rate=100.0, n_axes=1, n_dwells=6, identities={"gyro": gyro},
                 meta=meta, events=events)  # fmt: skip
    write_record(records["early"], seconds=40.0, sample_rate=100.0, n_axes=1, n_dwells=1)
    write_record(records["axes"], seconds=600.0, n_axes=3, n_dwells=60)
    find = ["find", "--speed", "max", "--quiet", "--json", "--seed"]
    placed = ["--position", "50.429,30.523,170"]
    run([*find, "1", *placed, "--time", "960", "--out", str(folder / "find")])
    run([*find, "2", "--plan", "six-position", "--out", str(folder / "six")])
    run([*find, "3", "--time", "120", "--latitude", "50.429", "--repeat", "4", "--out", str(folder / "many")])
    south = ["--sim-azimuth", "359.95", "--sim-latitude", "-65", "--position=-65,-64.26"]
    run([*find, "4", *south, "--time", "300", "--out", str(folder / "south")])
    run([*find, "5", *placed, "--plan", "two-position", "--out", str(folder / "triad")])
    sources = {name: [path] for name, path in records.items()}
    sources |= {name: sorted((folder / name).glob("*.sqlite")) for name in ("find", "six", "many", "south", "triad")}
    pages = {}
    for name, paths in sources.items():
        pages[name] = folder / f"{name}.html"
        run(["report", *map(str, paths), "-o", str(pages[name])])
    return pages


def run(arguments: list[str]) -> None:
    """Run ``northfinder``."""
    subprocess.run([sys.executable, "-m", "northfinder", *arguments], stdout=subprocess.DEVNULL, check=True)


class Chromium:
    """The browser, without a window and without anything of its own that wants the network."""

    def __init__(self, command: str, folder: Path) -> None:
        """Keep its profile and its logs in `folder`; find out what it asks for by itself."""
        self.net_log = folder / "net.json"
        self._command = [
            command, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-extensions",
            "--disable-default-apps", "--metrics-recording-only", "--host-resolver-rules=MAP * ~NOTFOUND",
            "--enable-logging=stderr", f"--user-data-dir={folder / 'profile'}", f"--log-net-log={self.net_log}",
        ]  # fmt: skip
        self._own: set[str] = set()
        empty = folder / "empty.html"
        empty.write_text("<!doctype html><title>empty</title><p>nothing", encoding="utf-8")
        _, asked = self.open(empty, f"--screenshot={folder / 'empty.png'}")
        self._own = {each.removeprefix("asks for ") for each in asked}

    def open(self, page: Path, *options: str) -> tuple[str, list[str]]:
        """Open a page; return what was printed, and what the page said or asked for."""
        done = subprocess.run(
            [*self._command, *options, page.absolute().as_uri()],
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
        )
        said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
        return done.stdout, said + self._requests(page)

    def _requests(self, page: Path) -> list[str]:
        """Return the requests for anything but the page itself, by the browser's own log."""
        log = self.net_log.read_text(encoding="utf-8", errors="replace")
        asked = {urlsplit(url) for url in re.findall(r'"url":"([^"]+)"', log)}
        foreign = {f"{url.scheme}://{url.netloc}" for url in asked if url.scheme not in _INTERNAL}
        files = {url.geturl() for url in asked if url.scheme == "file"} - {page.absolute().as_uri()}
        return [f"asks for {each}" for each in sorted((foreign | files) - self._own)]


def look(chromium: Chromium, name: str, page: Path, folder: Path) -> list[str]:
    """Render a page in all ways; return what is wrong with it."""
    wrong = []
    for width in WIDTHS:
        height, found = measure(chromium, page, width)
        wrong += [f"{name} at {width} px: {each}" for each in found]
        for scheme, options in SCHEMES.items():
            shot = folder / f"{name}-{width}-{scheme}.png"
            _, said = chromium.open(page, *options, f"--window-size={width},{height}", f"--screenshot={shot}")
            wrong += [f"{name} at {width} px, {scheme}: {each}" for each in said]
    paper = folder / f"{name}.pdf"
    _, said = chromium.open(page, "--no-pdf-header-footer", f"--print-to-pdf={paper}")
    wrong += [f"{name} on paper: {each}" for each in said]
    if (pdftoppm := shutil.which("pdftoppm")) is not None:
        subprocess.run([pdftoppm, "-r", "70", "-png", str(paper), str(folder / f"{name}-A4")], check=True)
    return wrong


def measure(chromium: Chromium, page: Path, width: int) -> tuple[int, list[str]]:
    """Return how tall a page is at a width, and what is wrong with its texts."""
    text = page.read_text(encoding="utf-8")
    bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text, count=1)
    framed = FRAME.replace("WIDTH", str(width)).replace(
        "PAGE", html.escape(bare.replace("</body>", MEASURE + "</body>"))
    )
    measured = page.with_suffix(".measured.html")
    measured.write_text(framed, encoding="utf-8")
    dom, _ = chromium.open(measured, "--window-size=1400,800", "--dump-dom")
    found = re.search(r'<pre id="measured">(.*?)</pre>', dom, re.DOTALL)
    if found is None:
        return 4000, ["it could not be measured"]
    result = json.loads(html.unescape(found[1]))
    told = [str(each) for each in result["found"]] if result["texts"] > 20 else ["it shows next to no text"]
    return int(result["height"]), told


def main() -> None:
    """Make the pages, look at them, and say what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", metavar="PAGE", help="of them only these")
    arguments = parser.parse_args()
    command = browser()
    if command is None:
        raise SystemExit(f"no browser: expected one of {', '.join(BROWSERS)}")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        chromium = Chromium(command, Path(scratch))
        for name, page in make_pages(Path(scratch)).items():
            if not arguments.names or name in arguments.names:
                print(f"{name} ...", file=sys.stderr)
                wrong += look(chromium, name, page, arguments.folder)
    print("\n".join(wrong) or "nothing is wrong")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    os.environ.setdefault("NO_COLOR", "1")
    main()
