# The usual commands, for users of `just`. They can all be typed as well.

# Release build
build:
    cargo build --release --locked

# Run the checks that need no ROS (about two minutes)
quick:
    tests/quick.sh

# Run all checks; installs missing parts of ROS 1 (needs root)
test:
    tests/run.sh

# Measure all tables of docs/benchmarks.md and write them (takes long; needs root and a quiet computer)
benchmarks:
    benches/run.sh

# Show a rescue with a real rosmaster and nodes
quickstart:
    examples/quickstart.sh

# The documents as a book with search: target/book/index.html (needs mdBook: cargo install mdbook)
docs:
    packaging/build-book.sh
