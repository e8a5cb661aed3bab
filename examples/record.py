"""Reads lines from standard input and draws them as an SVG, in which each line lights up at the time it was read."""

import datetime
import html
import os
import re
import sys
import time

ROW, LEFT, TOP, WIDTH = 20, 18, 58, 860

HEAD = """<svg xmlns="http://www.w3.org/2000/svg" xml:space="preserve" viewBox="0 0 {width} {height}" width="{width}" height="{height}">
<title>A rosmaster is killed, and rosrescue brings a new one to the same state</title>
<style>
text {{ font: 13.5px ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace }}
.step, .dead {{ font-weight: 600 }}
rect {{ fill: #fff; stroke: #d1d9e0 }} circle {{ fill: #d1d9e0 }} text {{ fill: #1f2328 }} .quiet {{ fill: #59636e }}
.step {{ fill: #0550ae }} .dead {{ fill: #b3261e }} .good {{ fill: #1a7f37 }}
@media (prefers-color-scheme: dark) {{
rect {{ fill: #0d1117; stroke: #3d444d }} circle {{ fill: #3d444d }} text {{ fill: #e6edf3 }} .quiet {{ fill: #9198a1 }}
.step {{ fill: #79c0ff }} .dead {{ fill: #ff7b72 }} .good {{ fill: #56d364 }}
}}
@keyframes come {{ from {{ opacity: .25 }} }}
.line {{ animation: come 1ms backwards }}
@media (prefers-reduced-motion: reduce) {{ .line {{ animation: none }} }}
</style>
<rect x=".5" y=".5" width="{right}" height="{bottom}" rx="8"/>
<circle cx="22" cy="20" r="6"/><circle cx="42" cy="20" r="6"/><circle cx="62" cy="20" r="6"/>
<text class="quiet" x="{middle}" y="25" text-anchor="middle">{title}</text>
"""


def kind(line):
    if "kill -9" in line or "WRONG" in line:
        return "dead"
    if line.startswith("$ "):
        return "quiet"
    if re.match(r"\d+\. ", line):
        return "step"
    if "knew everything" in line or "none lost" in line or "Everything worked" in line:
        return "good"
    return "text"


# The recording begins when rosrescue starts. Installing and building are not part of the rescue.
lines, began = [], None
for line in sys.stdin:
    line = line.rstrip("\n")
    print(line, file=sys.stderr)
    if began is None and "rosrescue core" in line:
        began = time.monotonic()
        lines.append((0, "$ examples/quickstart.sh"))
    if began is not None and line:
        lines.append((time.monotonic() - began, line))
if not lines:
    sys.exit("record.py: the input has no rescue")

title = f"examples/quickstart.sh in real time, {os.cpu_count()} cores, {datetime.date.today()}"
height = TOP + ROW * len(lines)
size = dict(width=WIDTH, height=height, right=WIDTH - 1, bottom=height - 1, middle=WIDTH // 2)
print(HEAD.format(title=title, **size), end="")
for row, (after, line) in enumerate(lines):
    place = f'x="{LEFT}" y="{TOP + ROW * row}" style="animation-delay:{after:.2f}s"'
    print(f'<text class="line {kind(line)}" {place}>{html.escape(line, quote=False)}</text>')
print("</svg>")
