#!/usr/bin/env bash
# Records a rescue: runs examples/quickstart.sh and draws its output with the real times.
#
#     examples/record.sh >rescue.svg
#
# It needs Python 3 and everything that the quickstart needs. The picture works in light and dark mode and refers to no
# other file. Where an SVG may be animated, its lines light up once, in real time.
# ROSRESCUE=/path/to/rosrescue uses a program that is already built.

set -euo pipefail
cd "$(dirname "$0")/.."
NO_COLOR=1 examples/quickstart.sh | /usr/bin/python3 examples/record.py
