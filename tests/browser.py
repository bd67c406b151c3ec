"""Opens a page in a headless Chromium, does things to it, and tells what came of it: no driver, nothing but the browser.

The page is copied, and gets two scripts: the first collects errors, the second is the test's own. It runs as the body of an
async function once the page is drawn, and what it returns comes back. 3-D views are drawn in software.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--hide-scrollbars --virtual-time-budget=60000"
)
PATIENCE = 600  # s: a busy machine draws 3-D in software very slowly
COLLECT = """<script>
const problems = [], requests = [];
addEventListener("error", e => problems.push(String(e.message)));
addEventListener("unhandledrejection", e => problems.push(String(e.reason)));
console.error = (...words) => problems.push(words.join(" "));
const watch = new PerformanceObserver(list => requests.push(...list.getEntries().map(e => e.name)));
watch.observe({ type: "resource", buffered: true });
</script>"""
ACT = """<script>
const wait = () => new Promise(done => setTimeout(done, 50));
const until = async (holds, most = 400) => { for (let i = 0; i < most && !holds(); i++) await wait(); };
const $ = selector => document.querySelector(selector), $$ = selector => [...document.querySelectorAll(selector)];
const drawn = () => !$("#library") && $$(".plot, .stage").every(box => box.querySelector(".main-svg"));
(async () => {
  await until(drawn);
  let answer = null;
  try { answer = await (async () => { %s })(); } catch (error) { problems.push(String(error)); }
  const told = { answer, problems, requests: requests.filter(name => !/^(data|blob):/.test(name)), drawn: drawn() };
  document.documentElement.innerHTML = "";
  document.body.append(Object.assign(document.createElement("pre"), { id: "told", textContent: JSON.stringify(told) }));
})();
</script>"""


def open_page(html: str, folder: Path, script: str = "", fragment: str = "", width: int = 1280) -> Any:
    """What a script returns in a page, after checking that the page was drawn, without errors, from its one file.

    Args:
        html: The page.
        folder: Where files may be left.
        script: JavaScript; `$` and `$$` find elements, `until(holds)` waits.
        fragment: Of the address, such as "view-3".
        width: Of the window, px.
    """
    assert "<head>" in html
    assert "</body>" in html
    page = folder / "opened.html"
    page.write_text(html.replace("<head>", f"<head>{COLLECT}", 1).replace("</body>", ACT % script + "</body>"), "utf-8")
    flags = [*FLAGS.split(), f"--window-size={width},900", f"--user-data-dir={folder / 'user'}", "--dump-dom"]
    browser = subprocess.Popen(
        [str(CHROMIUM), *flags, f"file://{page}#{fragment}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"HOME": str(folder)},
        start_new_session=True,  # so that its children can be ended with it
    )
    try:
        said, complained = browser.communicate(timeout=PATIENCE)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(browser.pid, signal.SIGKILL)
    shutil.rmtree(folder / "user", ignore_errors=True)
    found = re.search(r'<pre id="told">(.*?)</pre>', said, re.DOTALL)
    assert found, complained[-2000:]
    told = json.loads(unescape(found[1]))
    assert told["problems"] == []
    assert told["requests"] == []
    assert told["drawn"]
    return told["answer"]
