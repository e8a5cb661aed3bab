use std::fs;
use std::path::PathBuf;

use ros1_master::xmlrpc::Value;

use crate::computer::Computer;
use crate::fleet::Fleet;
use crate::turn;

/// A copy of the checkpoint files.
pub(crate) struct Disk(Vec<(PathBuf, Vec<u8>)>);

impl Disk {
    pub(crate) fn of(computer: &Computer) -> Self {
        let files = fs::read_dir(computer.path("")).unwrap();
        let paths = files.map(|file| file.unwrap().path());
        let paths = paths.filter(|path| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            path.is_file() && name.starts_with("chkpt.yaml") && !name.ends_with(".lock")
        });
        Self(
            paths
                .map(|path| (path.clone(), fs::read(path).unwrap()))
                .collect(),
        )
    }

    /// Replaces the computer's checkpoint files with this copy.
    pub(crate) fn put_back(&self, computer: &Computer) {
        for (path, _) in Self::of(computer).0 {
            fs::remove_file(path).unwrap();
        }
        for (path, bytes) in &self.0 {
            fs::write(path, bytes).unwrap();
        }
    }
}

/// The power fails before the last writes are on the leader's disk; etcd has them. On the other computers rosrescue is
/// stopped, as during an upgrade, so only this one can lead.
#[test]
fn a_leader_whose_disk_is_older_than_etcds_journal_takes_the_journal() {
    let _turn = turn();
    let mut fleet = Fleet::start(&[]);
    let leader = fleet.await_whole();
    fleet.computers[leader].set_param("/before", 1);
    fleet.await_same_state();
    let old = Disk::of(&fleet.computers[leader]);
    let keys: Vec<_> = (0..20)
        .map(|number| format!("/acknowledged/k{number}"))
        .collect();
    for (number, key) in (0..).zip(&keys) {
        fleet.computers[leader].set_param(key, number);
    }
    let others = fleet.others(leader);
    for &other in &others {
        fleet.computers[other].stop_rescue();
    }
    fleet.computers[leader].power_off();
    old.put_back(&fleet.computers[leader]);
    fleet.bring_back(leader);
    for &other in &others {
        fleet.computers[other].start_rescue();
        fleet.computers[other].await_answers();
    }
    fleet.await_same_state();
    for computer in &fleet.computers {
        assert_eq!(computer.param("/before"), Some(Value::Int(1)));
        let lost: Vec<_> = (0..)
            .zip(&keys)
            .filter(|(number, key)| computer.param(key) != Some(Value::Int(*number)))
            .collect();
        assert!(
            lost.is_empty(),
            "{} of 20 acknowledged writes are gone on {}: {lost:?}",
            lost.len(),
            computer.name
        );
    }
    fleet.assert_nodes_live();
}
