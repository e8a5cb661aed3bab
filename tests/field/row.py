#!/usr/bin/python3
"""Writes a row of a table between two markers of a document: row.py FILE SECTION CELL...

Replaces the row that starts with the first cell, or adds a row at the end. The head of the table must be there.
"""

import sys

path, section, *cells = sys.argv[1:]
with open(path) as file:
    lines = file.read().split("\n")
begin = lines.index("<!-- %s: begin -->" % section)
end = lines.index("<!-- %s: end -->" % section)
row = "| %s |" % " | ".join(cells)
rows = [number for number in range(begin, end) if lines[number].startswith("| %s |" % cells[0])]
if rows:
    lines[rows[0]] = row
else:
    last = max(number for number in range(begin, end) if lines[number].startswith("|"))
    lines.insert(last + 1, row)
with open(path, "w") as file:
    file.write("\n".join(lines))
