//! Runs the checks of the fuzz targets on their seeds, which include every input that ever failed. `fuzz/README.md`
//! explains how to search for more.

#[path = "../../fuzz/checks/checkpoint.rs"]
mod checkpoint;
#[path = "../../fuzz/checks/cluster.rs"]
mod cluster;
#[path = "../../fuzz/checks/headers.rs"]
mod headers;
#[path = "../../fuzz/checks/history.rs"]
mod history;
#[path = "../../fuzz/checks/seal.rs"]
mod seal;
#[path = "../../fuzz/checks/seal_records.rs"]
mod seal_records;
#[path = "../../fuzz/checks/xmlrpc.rs"]
mod xmlrpc;

use std::fs;
use std::path::Path;

fn each_seed(target: &str, check: fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    let mut count = 0;
    for entry in fs::read_dir(folder.join(target)).unwrap() {
        let path = entry.unwrap().path();
        // Shown if the test fails.
        println!("{}", path.display());
        check(&fs::read(&path).unwrap());
        count += 1;
    }
    assert!(count > 10, "only {count} seeds of {target} were found");
}

#[test]
fn the_seeds_of_the_xmlrpc_fuzz_target_pass() {
    each_seed("xmlrpc", xmlrpc::check);
}

#[test]
fn the_seeds_of_the_checkpoint_fuzz_target_pass() {
    each_seed("checkpoint", checkpoint::check);
}

#[test]
fn the_seeds_of_the_history_fuzz_target_pass() {
    each_seed("history", history::check);
}

#[test]
fn the_seeds_of_the_cluster_fuzz_target_pass() {
    each_seed("cluster", cluster::check);
}

#[test]
fn the_seeds_of_the_headers_fuzz_target_pass() {
    each_seed("headers", headers::check);
}
