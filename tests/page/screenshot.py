#!/usr/bin/env python3
"""Takes a picture of the page with Chromium: screenshot.py URL FILE [WIDTH HEIGHT [dark]]

It waits until the graph, the list and some seconds of the curve are there.
"""
import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time

READY = """document.querySelectorAll('#picture .box').length > 3 && document.querySelector('#list tr')
    && document.querySelector('#spark polyline').getAttribute('points')?.split(' ').length > 25"""


class Page:
    """A page in a headless Chromium, driven by the DevTools protocol over its file descriptors 3 and 4."""

    def __init__(self, profile):
        # Above 3 and 4, which the child needs.
        commands, self.commands = (os.dup2(end, 20 + end) for end in os.pipe())
        self.answers, answers = (os.dup2(end, 20 + end) for end in os.pipe())

        def take_pipes():
            os.dup2(commands, 3)
            os.dup2(answers, 4)

        self.process = subprocess.Popen(
            ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
             "--remote-debugging-pipe", f"--user-data-dir={profile}", "about:blank"],
            preexec_fn=take_pipes, close_fds=False, stderr=subprocess.DEVNULL)
        self.count, self.session, self.rest = 0, {}, b""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.session = {"sessionId": session}

    def call(self, method, **params):
        self.count += 1
        call = {"id": self.count, "method": method, "params": params, **self.session}
        os.write(self.commands, json.dumps(call).encode() + b"\0")
        while True:
            message, found, rest = self.rest.partition(b"\0")
            if not found:
                self.rest += os.read(self.answers, 1 << 16)
                continue
            self.rest = rest
            answer = json.loads(message)
            if answer.get("id") == self.count:
                return answer["result"]

    def value(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")


def main():
    uri, file, *screen = sys.argv[1:]
    width, height = map(int, screen[:2] or (1280, 900))
    scheme = "dark" if "dark" in screen else "light"
    if not shutil.which("chromium"):
        sys.exit("screenshot.py: there is no chromium: apt-get install chromium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        page = Page(profile)
        try:
            page.call("Emulation.setDeviceMetricsOverride", width=width, height=height,
                      deviceScaleFactor=1, mobile=width < 600)
            feature = {"name": "prefers-color-scheme", "value": scheme}
            page.call("Emulation.setEmulatedMedia", features=[feature])
            page.call("Page.navigate", url=uri)
            end = time.monotonic() + 60
            while not page.value(f"Boolean({READY})"):
                if time.monotonic() > end:
                    sys.exit(f"screenshot.py: {uri} does not show a robot")
                time.sleep(0.2)
            # Marks of the last minutes are far enough apart to see.
            page.value("""document.querySelector('#time-span').value = 600;
                document.querySelector('#time-span').dispatchEvent(new Event('change'))""")
            while not page.value("Boolean(document.querySelector('.mark'))"):
                time.sleep(0.2)
            # On a phone the graph is below the edge of the screen.
            bottom = page.value("document.querySelector('#picture').getBoundingClientRect().bottom + 24")
            clip = {"x": 0, "y": 0, "width": width, "height": max(height, bottom if width < 600 else 0), "scale": 1}
            shot = page.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
            with open(file, "wb") as out:
                out.write(base64.b64decode(shot["data"]))
        finally:
            page.process.terminate()
            page.process.wait()


main()
