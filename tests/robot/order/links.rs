//! Real nodes that start at the same moment make every link between them. `cargo bench --bench links` runs
//! this for longer and describes what happens.

use crate::support::links::{self, Place, Plan};
use crate::support::{Library, PATIENCE};

/// Runs one start.
#[track_caller]
fn every_link_is_made(place: Place, library: Library) {
    let seed = u64::from(std::process::id());
    println!("seed {seed}");
    let plan = Plan {
        library,
        nodes: 8,
        // The kills must come while the nodes register.
        links: if place == Place::Kills { 480 } else { 240 },
        // On a busy computer some links take 13 s.
        wait: PATIENCE,
        ..Plan::default()
    };
    links::start(place, &plan, seed).assert_whole(&plan);
}

#[test]
fn every_link_is_made_through_core() {
    every_link_is_made(Place::Core, Library::Rospy);
}

#[test]
fn every_link_is_made_while_the_mirror_stands_in() {
    every_link_is_made(Place::StandingIn, Library::Rospy);
}

#[test]
fn every_link_is_made_while_master_and_worker_are_killed() {
    every_link_is_made(Place::Kills, Library::Rospy);
}

#[test]
fn every_link_is_made_by_the_nodes_of_a_follower() {
    every_link_is_made(Place::Follower, Library::Rospy);
}

#[test]
fn every_link_is_made_by_roscpp_through_proxy() {
    every_link_is_made(Place::Proxy, Library::Roscpp);
}
