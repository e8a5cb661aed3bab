#!/usr/bin/python3
"""Follows the links of all documents and pages below a folder. Usage: follow_links.py FOLDER

Prints links to files, or to sections of documents, that do not exist. Links to other computers are not followed.
"""

import html.parser
import pathlib
import re
import sys
import urllib.parse


class Page(html.parser.HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self):
        html.parser.HTMLParser.__init__(self)
        self.links, self.anchors = [], set()

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("href", "src") and value and tag != "base":
                self.links.append(value)
            elif name in ("id", "name"):
                self.anchors.add(value)


def heading(text):
    """The anchor that GitHub gives to a heading."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text).strip().lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def read(path):
    """The links and the anchors of a file."""
    text = path.read_text()
    if path.suffix == ".html":
        page = Page()
        page.feed(text)
        return page.links, page.anchors
    text = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    plain = re.sub(r"`[^`\n]*`", "``", text)
    return re.findall(r"\]\(([^)\s]+)", plain), {heading(line) for line in re.findall(r"^#+ (.*)", text, re.M)}


def main():
    root = pathlib.Path(sys.argv[1])
    files = {path.resolve(): read(path) for path in sorted(root.rglob("*")) if path.suffix in (".md", ".html")}
    count = 0
    for path, (links, _) in files.items():
        for link in links:
            address = urllib.parse.urlsplit(link)
            if address.scheme or address.netloc:
                continue
            count += 1
            to = (path.parent / urllib.parse.unquote(address.path)).resolve() if address.path else path
            anchor = urllib.parse.unquote(address.fragment)
            if not to.exists():
                print(f"{path}: {link} does not exist")
            elif anchor and to in files and anchor not in files[to][1]:
                print(f"{path}: {link} has no such section")
    print(f"{count} links in {len(files)} files", file=sys.stderr)


main()
