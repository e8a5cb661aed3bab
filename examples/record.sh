#!/usr/bin/env bash
# Records a rescue: runs examples/quickstart.sh, and draws what it says, when it says it.
#
#     examples/record.sh >rescue.svg
#
# It needs Python 3 and what the quickstart needs. The picture needs nothing but itself, in light and in dark: its
# lines light up in real time, once, where an SVG may move.
# ROSRESCUE=/path/to/rosrescue takes a binary that is there already.

set -euo pipefail
cd "$(dirname "$0")/.."
NO_COLOR=1 examples/quickstart.sh | /usr/bin/python3 examples/record.py
