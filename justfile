# The few commands, for those who have `just`. Nothing needs it: each is a line to type.

# Release build
build:
    cargo build --release --locked

# Checks without ROS, some two minutes
quick:
    tests/quick.sh

# Every check; installs what is missing of ROS 1 (needs root)
test:
    tests/run.sh

# The tables of benches/results.md
bench:
    cargo bench --bench pauses
    cargo bench --bench table1
    cargo bench --bench compare
    . tests/install_etcd.sh && cargo bench --bench computers

# A rescue to look at, with a real rosmaster and nodes
quickstart:
    examples/quickstart.sh

# The documents as a book with search: target/book/index.html (needs mdBook: cargo install mdbook)
docs:
    packaging/build-book.sh
