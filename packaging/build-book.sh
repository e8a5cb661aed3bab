#!/bin/sh
# packaging/build-book.sh: collects the documents in target/book-source, and makes a book with search of them in
# target/book. Exit status 3 if there is no mdBook (cargo install mdbook).
set -eu
cd "$(dirname "$0")/.."
source=target/book-source
theme=target/book-theme

rm -rf "$source" "$theme" target/book
mkdir -p "$source" "$theme/fonts"
cp --parents ./*.md docs/*.md docs/*.svg docs/*.png docs/decisions/*.md benches/*.md fuzz/*.md examples/robot/*.md "$source"
echo "/* The fonts of the system. */" >"$theme/fonts/fonts.css"
if ! command -v mdbook >/dev/null; then
    echo "build-book.sh: mdbook is not installed (cargo install mdbook), so there is no book" >&2
    exit 3
fi
# mdBook wants the table of contents at the top, with every decision. docs has it for GitHub.
sed -n 's,^| \[\([0-9]*\)\](\([^)]*\)) | \(.*\) | .*,  - [\1. \3](docs/decisions/\2),p' docs/decisions/README.md >"$source/decisions"
sed -e 's,](,](docs/,' -e 's,](docs/\.\./,](,' -e "/decisions\/README.md/r $source/decisions" docs/SUMMARY.md >"$source/SUMMARY.md"
rm "$source/decisions"
MDBOOK_LOG=warn mdbook build
rm "$source/SUMMARY.md"
echo target/book/index.html
