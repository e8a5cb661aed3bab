//! Tests of the simulated computers: cables and ports are cut, and etcd survives what it should survive.

use std::net::TcpStream;
use std::time::Duration;

use crate::fleet::Fleet;
use crate::network::address;
use crate::support::{alive, comes_true, eventually};

/// Whether a connection can be made within half a second.
fn reaches(fleet: &Fleet, from: usize, to: usize, port: u16) -> bool {
    let address = format!("{}:{port}", address(to)).parse().unwrap();
    let limit = Duration::from_millis(500);
    fleet.computers[from].within(|| TcpStream::connect_timeout(&address, limit).is_ok())
}

#[test]
fn cables_pairs_ports_and_computers_are_cut_and_come_back() {
    let _turn = crate::turn();
    let mut fleet = Fleet::empty(&[]);
    let healthy = |fleet: &Fleet, index: usize, is: bool| {
        eventually(&format!("etcd {index} is healthy: {is}"), || {
            fleet.computers[index].etcd_is_healthy() == is
        });
    };
    fleet.network.cut_cable(0);
    assert!(!reaches(&fleet, 0, 1, 2379) && !reaches(&fleet, 1, 0, 2379));
    healthy(&fleet, 0, false);
    healthy(&fleet, 1, true);
    fleet.network.mend_cable(0);
    fleet.await_etcd();
    fleet.network.cut_pair(0, 1);
    assert!(!reaches(&fleet, 0, 1, 2379) && !reaches(&fleet, 1, 0, 2379));
    assert!(comes_true(
        || reaches(&fleet, 0, 2, 2379) && reaches(&fleet, 2, 1, 2379)
    ));
    fleet.network.mend_pair(0, 1);
    fleet.network.cut_port(2, 1, 2379);
    assert!(!reaches(&fleet, 2, 1, 2379));
    assert!(comes_true(|| {
        reaches(&fleet, 2, 1, 2380) && reaches(&fleet, 1, 2, 2379) && reaches(&fleet, 0, 1, 2379)
    }));
    fleet.network.mend_port(2, 1, 2379);
    assert!(comes_true(|| reaches(&fleet, 2, 1, 2379)));
    let before = fleet.scratch.survivors().len();
    fleet.computers[2].power_off();
    let after = fleet.scratch.survivors();
    assert!(
        after.iter().all(|&(pid, _)| alive(pid)) && after.len() * 3 == before * 2,
        "{before} {after:?}"
    );
    assert!(!reaches(&fleet, 0, 2, 2379));
    healthy(&fleet, 0, true);
    fleet.computers[2].boot();
    fleet.computers[2].start_etcd();
    fleet.await_etcd();
}
