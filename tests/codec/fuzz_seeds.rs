//! What the fuzz targets check of any bytes holds of their seeds, among which is every input that
//! ever failed. `fuzz/README.md` says how to look for more.

#[path = "../../fuzz/checks/checkpoint.rs"]
mod checkpoint;
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
    assert!(count > 10, "the seeds of {target} are not where they were");
}

#[test]
fn seeds_of_the_xmlrpc_target_hold() {
    each_seed("xmlrpc", xmlrpc::check);
}

#[test]
fn seeds_of_the_checkpoint_target_hold() {
    each_seed("checkpoint", checkpoint::check);
}
